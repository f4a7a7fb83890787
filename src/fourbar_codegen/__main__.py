"""``python -m fourbar_codegen``: the command line."""

from fourbar_codegen.cli import main

if __name__ == "__main__":
    main()
