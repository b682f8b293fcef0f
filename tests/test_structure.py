"""The layout of the package: sizes, imports that run one way, words that are no names."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "brokk_min"
METHOD = ("__init__", "machine", "kinematics", "actuator", "env", "ppo", "jacobian", "hw")
WINGS = ("identification", "learning", "evaluation", "can", "viewer", "cli")
BYTES = {"can.canopen", "can.connection", "can.safety_gate"}  # what hw.py may import as well
MODULES = sorted(PACKAGE.rglob("*.py"))
TREES = {path: ast.parse(path.read_text()) for path in MODULES}

# Names of the first edition that mean nothing outside it.
PRIVATE = """
    way ways bends tilts rises joint_rates damped_rates push_lag told sensed look RAMP
    Outcome rest_state fitting_nets push_measured push_motion valve_scale FINE STILL STAND
    far far_ends LEG Tape hover by_tool by_velocity tails out_of_step identity_of SteadyMap
    winding Mover judge trust apart said Effort supply_demand whole_counts wishes Wish Jog
    Hands Line hear note spoken wrong pace KEPT PUSH held_back _rehearse asked Known looks
    weakest Mailbox MOODS need
"""
PRIVATE_MODULES = """
    plant observation extras scores trust environments adjoint mpc chain gate bus wishes
    simulator blackbox ticks looks view remote variations experiments
"""


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def imports(path: Path) -> set[str]:
    """Modules of the package that a module imports, without `TYPE_CHECKING` blocks."""
    found = set()
    nodes = list(ast.walk(TREES[path]))
    types = [n for n in nodes if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.dump(n.test)]
    for_types = {id(inner) for node in types for inner in ast.walk(node)}
    for node in nodes:
        if id(node) in for_types:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found & {f"brokk_min.{name_of(module)}" for module in MODULES}


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports__run_one_way(path):
    """Method files know one another, hw.py the bytes and the gate, wings the wings above them."""
    wing = path.parent.name if path.parent != PACKAGE else ""
    for module in imports(path):
        module = module.removeprefix("brokk_min.")
        other = module.split(".")[0]
        if wing:
            assert other not in WINGS or WINGS.index(other) <= WINGS.index(wing), module
        elif path.stem != "__main__":
            assert other in METHOD or (path.stem == "hw" and module in BYTES), module


def test_the_top__has_the_method_files_alone():
    assert {path.stem for path in PACKAGE.glob("*.py")} == {*METHOD, "__main__"}
    assert {path.parent.name for path in MODULES} == {*WINGS, "brokk_min"}


def test_sizes__of_the_method_files():
    lines = [len((PACKAGE / f"{name}.py").read_text().splitlines()) for name in METHOD]
    assert max(lines) <= 330
    assert sum(lines) <= 1890


def code_lines(path: Path) -> set[int]:
    """Lines that hold code, not only comments, docstrings or brackets."""
    text = path.read_text()
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    skipped = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    lines = {t.start[0] for t in tokens if t.type not in skipped and t.string.strip("()[]{},: ")}
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


@pytest.mark.parametrize("name", METHOD)
def test_functions__of_the_method_have_at_most_25_lines_of_code(name):
    path = PACKAGE / f"{name}.py"
    code = code_lines(path)
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.FunctionDef):
            body = range(node.body[0].lineno, (node.end_lineno or 0) + 1)
            size = len(code & set(body))
            assert size <= 25, f"{name}.{node.name}: {size}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_names__are_words_of_the_field(path):
    nodes = list(ast.walk(TREES[path]))
    defined = {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    arguments = {n.arg for n in nodes if isinstance(n, ast.arg)}
    assert not (defined | arguments) & set(PRIVATE.split())
    assert path.stem not in PRIVATE_MODULES.split()


def test_glossary__has_at_most_25_entries():
    text = ast.get_docstring(TREES[PACKAGE / "__init__.py"]) or ""
    entries = re.findall(r"^    \S.*?  +\S", text.split("Glossary:\n")[1], re.M)
    assert 10 <= len(entries) <= 25
