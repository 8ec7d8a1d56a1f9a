"""What the mutation run changes, which tests it chooses, and what it writes."""

from __future__ import annotations

import ast
from pathlib import Path

from benchmarks import mutants
from benchmarks.mutants import Called, Mutant

CADENCE = Path("l2lidar_node/clock/cadence.py")


def changes(source: str) -> set[str]:
    return {
        f"{ast.unparse(before)} -> {ast.unparse(ast.fix_missing_locations(after))}"
        for before, after in mutants.mutations(ast.parse(source))
    }


def test_code_is_mutated_but_no_texts_and_no_annotations() -> None:
    assert changes("x = a < 3 and not b") == {
        "a < 3 -> a <= 3", "3 -> 4", "a < 3 and (not b) -> a < 3 or not b", "not b -> b",
    }  # fmt: skip
    assert changes("x += 2") == {"x += 2 -> x -= 2", "2 -> 3"}
    assert changes('def f(x: "a < b") -> int:\n    "1 < 2"\n    raise ValueError(3)') == set()
    assert changes("x = 'a' + b") == set()


def test_every_mutant_of_a_module_differs_from_it() -> None:
    whole = ast.dump(ast.parse((mutants.ROOT / CADENCE).read_text()))
    found = mutants.mutants_of(CADENCE)
    assert len(found) > 100
    for mutant in found[::10]:
        assert ast.dump(mutants.mutated(CADENCE, mutant.number)) != whole


def test_a_sample_is_the_same_for_a_seed_and_has_mutants_of_every_module() -> None:
    paths = [CADENCE, Path("l2lidar_node/clock/schedule.py")]
    some = mutants.sampled(paths, 20, 1)
    assert some == mutants.sampled(paths, 20, 1)
    assert some != mutants.sampled(paths, 20, 2)
    assert {mutant.path for mutant in some} == set(paths)
    assert set(mutants.sampled(paths, 10, 1)) < set(some)
    assert 19 <= len(some) <= 21


def test_a_mutant_meets_the_tests_that_call_its_function_its_own_first() -> None:
    lines = (mutants.ROOT / CADENCE).read_text().splitlines()
    first = next(n for n, line in enumerate(lines, 1) if "def advance(" in line)
    inside = Mutant(CADENCE, 0, first + 2, "")
    outside = Mutant(CADENCE, 1, 5, "")
    path = str(CADENCE)
    calls = {
        "tests/test_slow.py::a": Called(9.0, {path: [first]}),
        "tests/test_quick.py::b": Called(0.1, {path: [first]}),
        "tests/clock/test_cadence.py::c": Called(5.0, {path: [first]}),
        "tests/test_other.py::d": Called(0.1, {path: [first + 1]}),
        "tests/test_else.py::e": Called(0.1, {"l2lidar_node/clock/schedule.py": [first]}),
        "tests/test_endless.py::f": Called(100.0, {path: [first]}),
    }
    assert [test[-1] for test in mutants.tests_for(inside, calls)] == ["c", "b", "a"]
    assert {test[-1] for test in mutants.tests_for(outside, calls)} == {"a", "b", "c", "d"}


def test_the_page_names_what_lived_and_why() -> None:
    rows = [
        {"path": "a.py", "change": "x: 1 -> 2", "killed": True},
        {"path": "a.py", "change": "y: 1 -> 2", "killed": False},
        {"path": "b.py", "change": "z: < -> <=", "killed": True},
    ]
    page = mutants.report(rows, "--mutants 3")
    assert "2 of 3 killed (67 %)" in page
    assert "| `a.py` | 1 | 2 |" in page
    assert "* `a.py`: `y: 1 -> 2`: not explained" in page
