"""The layout of the package: imports run one way, and importing it changes nothing else."""

import ast
import graphlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "brokk_min"
METHOD = ["machine", "kinematics", "actuator", "fit", "jacobian", "settings", "env", "ppo"]
WINGS = ["_files", "beyond", "identification", "learning", "evaluation", "can", "viewer", "cli"]
ORDER = [*METHOD, "hw", "shadow", *WINGS, "__main__"]  # of the README: imports go to what is before
ABOVE_THE_BUS = {"evaluation", "hw", "shadow"}  # what no file of can/ imports
BESIDE = {
    "hw": {"can.canopen", "can.connection", "can.safety_gate"},
    "shadow": {"can.canopen", "can.connection"},
    "learning.gym_env": {"viewer.drawing"},  # of `render`
}
MODULES = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")}


def imports(name: str) -> set[str]:
    """Modules of the package that a module imports, anywhere in it, for types as well."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {module.removeprefix("brokk_min.") for module in found} & MODULES.keys()


@pytest.mark.parametrize("name", [name for name in MODULES if name != "__init__"])
def test_imports__run_in_the_order_of_reading(name):
    part = name.split(".")[0]
    allowed = {*ORDER[: ORDER.index(part)], part} - (ABOVE_THE_BUS if part == "can" else set())
    for module in imports(name) - BESIDE.get(name, set()):
        assert module.split(".")[0] in allowed, f"{name} imports {module}"


def test_imports__have_no_circle():
    """Not even for types: `ast.walk` sees those as well."""
    graphlib.TopologicalSorter({name: imports(name) for name in MODULES}).prepare()


SECRETS = {
    "hydraulics",
    "hydraulics_of",
    "Hydraulics",
    "HYDRAULICS",
    "Cylinder",
    "BROKK_CYLINDERS",
    "PlantState",
}
SECRETS |= {"BROKK_CYLINDERS", "cylinder_column", "cylinder_speeds", "lever_arm", "euler_step"}
MAY_READ = {"actuator", "machine"}  # the plant, and the machine that has the field
MAY_READ |= {"evaluation.reproduce", "evaluation.sequences"}  # what varies it, what is feasible


def test_hydraulics__are_read_by_the_plant_and_by_what_varies_it_alone():
    """Of benchmarks by the two that show what a controller would do that knew the machine."""
    files = MODULES | {f"benchmarks.{p.stem}": p for p in (ROOT / "benchmarks").glob("*.py")}
    readers = set()
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text())):
            words = {getattr(node, field, None) for field in ("id", "attr", "name", "arg")}
            if words & SECRETS:
                readers.add(name)
    assert readers == MAY_READ | {"benchmarks.perfect_model", "benchmarks.adaptation"}


def test_importing_the_package__changes_no_environment_and_imports_no_torch():
    """Nor NumPy at first, because the program sets its threads before; nor what no drive needs."""
    code = "import os, sys; before = dict(os.environ); import brokk_min"
    code += "; print('numpy' in sys.modules); import brokk_min.env, brokk_min.fit, brokk_min.hw"
    code += ", brokk_min.can.simulated_machine, brokk_min.learning.policy"
    code += "; heavy = {*'can pygame torch onnx matplotlib gymnasium scipy'.split()}"
    code += "; print(dict(os.environ) == before, *heavy & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.split() == ["False", "True"], done.stderr


@pytest.mark.parametrize("file", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_benchmarks__can_be_imported(file):
    """They take long, so that no test runs them whole."""
    importlib.import_module(f"benchmarks.{file.stem}")
