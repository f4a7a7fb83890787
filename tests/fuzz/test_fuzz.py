"""The first cases of each kind, and that the fuzzers find what is wrong."""

import os
from itertools import chain

import numpy as np
import pytest

import fourbar_codegen as fb
from fourbar_codegen.analysis import groups, polynomials
from fuzz import assemblies, calls, damage, kills, mechanisms
from fuzz.runner import PATHS, explore

pytestmark = pytest.mark.slow

SEED = 1
SHORT = {"calls": 2000, "mechanisms": 1, "assemblies": 200, "damage": 150, "kills": 2}


@pytest.mark.parametrize("kind", SHORT)
def test_first_random_cases_of_each_kind_find_nothing_wrong(kind):
    found = list(chain.from_iterable(explore(kind, SEED, SHORT[kind])))
    by_cause = {finding.cause: finding for finding in reversed(found)}
    assert not found, "\n\n".join(map(str, by_cause.values()))


def test_slider_with_an_offset_in_no_equation_compiles_and_agrees(capsys):
    """The offset of the third of three sliders stood in no equation, and could not be compiled."""
    mechanisms.case(np.random.default_rng([1, 5]), print)
    assert "errs by 0.0" in capsys.readouterr().out


def test_public_names_of_the_package_are_all_called_by_the_fuzzer():
    assert calls.missing() == set()


def findings(case, count):
    found = []
    for number in range(count):
        try:
            case(np.random.default_rng([SEED, number]), lambda text: None)
        except Exception as error:
            found.append(error)
    return found


def test_fuzzer_of_assemblies_finds_a_mode_that_is_left_out(monkeypatch):
    """Of two solutions of each group, the second is left out."""
    monkeypatch.setattr(groups, "real_roots", lambda *arguments: (polynomials.real_roots(*arguments) or [])[:1])
    assert len(findings(assemblies.case, 12)) > 6


def test_fuzzer_of_calls_finds_an_error_of_a_foreign_class(monkeypatch):
    def careless(*_, **__):
        raise KeyError("foreign")

    monkeypatch.setattr(calls, "calls_of", lambda name: {"rhs": calls.Call(careless, {"t": 0.0})})
    assert [str(error) for error in findings(calls.case, 5)] == ["'foreign'"] * 5


def test_fuzzer_of_calls_finds_results_that_differ_with_the_memory_layout(monkeypatch):
    """A function that takes the memory of whatever array for native numbers."""
    x = np.arange(1.0, 7.0)

    def careless(x):
        return np.frombuffer(np.asarray(x).tobytes()).copy() if np.asarray(x).dtype.kind == "f" else np.zeros(6)

    monkeypatch.setattr(calls, "calls_of", lambda name: {"rhs": calls.Call(careless, {"x": x})})
    assert any("instead of" in str(error) for error in findings(calls.case, 50))


def test_fuzzer_of_mechanisms_finds_rates_that_are_off_by_1e_9(monkeypatch):
    """One state's rates are off by 1e-9 of themselves."""
    compile_model = fb.compile_model

    def slightly_wrong(model):
        compiled = compile_model(model)

        class Wrong:
            parameters = compiled.parameters
            jacobian, output, output_jacobian = compiled.jacobian, compiled.output, compiled.output_jacobian

            def rhs(self, *arguments):
                return compiled.rhs(*arguments) * (1 + 1e-9)

        return Wrong()

    monkeypatch.setattr(fb, "compile_model", slightly_wrong)
    [error] = findings(mechanisms.case, 1)
    assert "x' errs by" in str(error)


def test_fuzzer_of_damage_finds_a_changed_run_that_is_read_silently(monkeypatch):
    other = damage.runs()["other.npz"][0]
    monkeypatch.setattr(fb, "load_trajectory", lambda path: other)
    monkeypatch.setattr(damage, "DAMAGE", (damage.flip,))
    assert any("Arrays are not equal" in str(error) for error in findings(damage.case, 20))


def test_fuzzer_goes_on_after_a_case_that_ends_its_process(monkeypatch, tmp_path):
    """And the cases behind it are done all the same."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys, types\n"
        "def case(generator, say):\n"
        "    say('before')\n"
        "    if generator.random() < 0.5: os.abort()\n"
        "module = types.ModuleType('fuzz.calls'); module.case = case; sys.modules['fuzz.calls'] = module\n"
    )
    path = os.pathsep.join(map(str, (tmp_path, *PATHS)))
    found = list(chain.from_iterable(explore("calls", SEED, 8, {"PYTHONPATH": path})))
    expected = [number for number in range(8) if np.random.default_rng([SEED, number]).random() < 0.5]
    assert [finding.number for finding in found] == expected
    assert all("Aborted" in finding.what or "-6" in finding.what for finding in found)
    assert 0 < len(expected) < 8


def test_fuzzer_of_kills_finds_a_file_that_was_written_in_place(monkeypatch):
    """Of a program that writes in place."""
    careless = kills.SAVE.replace(
        "run.save(sys.argv[1])", "open(sys.argv[1], 'w').write('half'); import time; time.sleep(9)"
    )
    monkeypatch.setattr(kills, "SAVE", careless)
    [error] = findings(lambda generator, say: kills.case(_Saving(generator), say), 1)
    assert "holds no trajectory" in str(error) or "is not an NPZ file" in str(error) or "half" in str(error)


class _Saving:
    """A generator that lets a process save, and long enough to begin."""

    def __init__(self, generator):
        self.choice = generator.choice

    def random(self):
        return 1.0

    def uniform(self, low, high):
        return high
