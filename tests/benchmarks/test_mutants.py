"""What the mutation run changes, which tests it chooses, and what it writes."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks import mutants
from benchmarks.mutants import Called, Mutant
from benchmarks.mutants_known import FAULTS

CADENCE = Path("l2lidar_node/clock/cadence.py")


def changes(source: str) -> set[str]:
    return {
        f"{ast.unparse(before)} -> {ast.unparse(ast.fix_missing_locations(after))}"
        for before, after in mutants.mutations(ast.parse(source))
    }


def test_code_is_mutated_but_no_texts_and_no_annotations() -> None:
    assert changes("x = a < b") == {"a < b -> a >= b"}
    assert changes("x = a < 3 and not b") == {
        "a < 3 -> a <= 3", "3 -> 4", "a < 3 and (not b) -> a < 3 or not b", "not b -> b",
    }  # fmt: skip
    assert changes("x += 2") == {"x += 2 -> x -= 2", "2 -> 3"}
    assert changes("x = (0, 16, 17, 0.25, 0.0)") == {
        "0 -> 1", "16 -> 17", "17 -> 170", "0.25 -> 2.5", "0.0 -> 1.0",
    }  # fmt: skip
    assert changes("def f(): return 17 * 0.25") == {
        "17 -> 34", "0.25 -> 0.5", "17 * 0.25 -> 17 // 0.25",
    }  # fmt: skip
    assert changes("Text = str | bytes") == set()
    assert changes('def f(x: "a < b") -> int:\n    "1 < 2"\n    raise ValueError(3)') == set()
    assert changes("x = 'a' + b") == set()


def test_everything_that_is_mutated_and_run_exists() -> None:
    for name in (*mutants.FOLDERS, *mutants.FILES, *mutants.TESTS):
        assert (mutants.ROOT / name).exists(), name


def test_every_mutant_of_a_module_differs_from_it() -> None:
    whole = ast.dump(ast.parse((mutants.ROOT / CADENCE).read_text()))
    found = mutants.mutants_of(CADENCE)
    assert len(found) > 100
    for mutant in found[::10]:
        assert ast.dump(mutants.mutated(CADENCE, mutant.number)) != whole


def test_a_sample_is_the_same_for_a_seed_and_has_mutants_of_every_module() -> None:
    paths = [CADENCE, Path("l2lidar_node/clock/device_clock.py")]
    some = mutants.sampled(paths, 20, 1)
    assert some == mutants.sampled(paths, 20, 1)
    assert some != mutants.sampled(paths, 20, 2)
    assert {mutant.path for mutant in some} == set(paths)
    assert set(mutants.sampled(paths, 10, 1)) < set(some)
    assert 19 <= len(some) <= 21


def test_a_mutant_meets_the_tests_that_call_its_function_its_own_first() -> None:
    inside = Mutant(CADENCE, 0, "Cadence.advance", "")
    outside = Mutant(CADENCE, 1, "", "")
    path = str(CADENCE)
    calls = {
        "tests/test_slow.py::a": Called(4.0, {path: ["Cadence.advance"]}),
        "tests/test_quick.py::b": Called(0.1, {path: ["Cadence.advance"]}),
        "tests/clock/test_cadence.py::c": Called(5.0, {path: ["Cadence.advance"]}),
        "tests/clock/test_cadence.py::g": Called(2.0, {}),
        "tests/test_other.py::d": Called(0.1, {path: ["Cadence.noise"]}),
        "tests/test_else.py::e": Called(0.1, {"l2lidar_node/clock/device_clock.py": ["advance"]}),
        "tests/test_endless.py::f": Called(100.0, {path: ["Cadence.advance"]}),
    }
    assert [test[-1] for test in mutants.tests_for(inside, calls, 10.0)] == ["c", "b", "a"]
    assert [test[-1] for test in mutants.tests_for(inside, calls, 1.0)] == ["c"]
    assert {test[-1] for test in mutants.tests_for(outside, calls, 12.0)} == {
        "a",
        "b",
        "c",
        "d",
        "g",
    }


def test_the_page_names_what_lived_and_why() -> None:
    rows = [
        {"path": "a.py", "number": 3, "change": "x: 1 -> 2", "killed": True},
        {"path": "a.py", "number": 4, "change": "y: 1 -> 2", "killed": False},
        {"path": "b.py", "number": 0, "change": "z: < -> <=", "killed": True},
        {"path": "b.py", "number": -1, "change": "old -> new", "killed": True},
    ]
    page = mutants.report(rows, "--mutants 3")
    assert "2 of 3 killed (66.7 %)" in page
    assert "* `b.py`: `old -> new`: killed" in page
    assert "| `a.py` | 1 | 2 |" in page
    assert "* `a.py`: `y: 1 -> 2`: not explained" in page


def test_a_mutant_knows_the_outermost_function_that_it_is_in() -> None:
    functions = {mutant.function for mutant in mutants.mutants_of(CADENCE)}
    assert {"", "Cadence.__init__", "Cadence.learn", "Cadence.gap"} <= functions
    for mutant in mutants.mutants_of(CADENCE):
        is_constant = mutant.change.startswith(("_", "FIRST_MODULUS"))
        assert (mutant.function == "") == is_constant, mutant


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_a_known_fault_still_fits_the_code(number: int) -> None:
    fault = FAULTS[number]
    assert (mutants.ROOT / fault.path).read_text().count(fault.before) == 1
    mutants.mutated(Path(fault.path), -1 - number)
    for test in fault.tests:
        assert (mutants.ROOT / test.partition("::")[0]).exists()
