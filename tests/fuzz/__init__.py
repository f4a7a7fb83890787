"""Random calls, mechanisms, damage and kills: `make fuzz`, and a short run in test_fuzz.py.

Each kind is a module with a function ``case(generator, say)``, which does one thing at random. It says what, and raises
whatever is wrong. `runner` does many of them, in processes of their own, so that a crash is a finding as well.
"""
