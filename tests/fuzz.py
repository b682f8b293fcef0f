"""Bad files of every format, made from the description of the formats, and read under limits.

Each field is removed, retyped, reshaped, made infinite, taken out of its range, repeated and nested
a thousand deep; bytes are cut, flipped, zeroed and put in. Every file must be read, if the change
was one of bytes, or refused by a ValueError: one line of at most 300 characters, with the file and,
for a changed field, its name. Memory (1 GiB more than at the start) and time (10 s) are limited.

    python tests/fuzz.py --files 500        # 500 files of each format
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import resource
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from helpers_machines import obedient_net, random_net, shared_net

from brokk_min.__main__ import LONGEST
from brokk_min.can.drive_log import read_frames
from brokk_min.cli.options import find_machine
from brokk_min.env import TaskConfig
from brokk_min.evaluation.baselines import baselines, gains_metadata, gains_table, read_gains
from brokk_min.evaluation.family import run_member
from brokk_min.evaluation.learn import QUICK
from brokk_min.evaluation.seeds import read_seeds, run_seed
from brokk_min.evaluation.sequences import read_commands, read_starts, task_sequences
from brokk_min.identification import formats
from brokk_min.identification.files import SHIPPED
from brokk_min.identification.formats import Field
from brokk_min.identification.logs import read_log
from brokk_min.identification.net_file import load_net, net_arrays
from brokk_min.learning.checkpoint import TrainingLog, describe_training
from brokk_min.learning.gym_env import TaskVectorEnv
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170, Machine
from brokk_min.ppo import PPOConfig, make_learner
from brokk_min.viewer.replay import read_results
from brokk_min.viewer.tracing import Attempt, read_attempts

MEMORY = 2**30  # bytes
SECONDS = 10
REMOVED = object()
NESTED = "nested a thousand deep"
NUMBERS = ("float", "number", "whole number")  # kinds of fields
SHIPPED_POLICY = SHIPPED / "brokk170" / "policy.npz"
Content = dict[str, Any]
Place = tuple[Any, ...]


class Format(NamedTuple):
    """A format: its file name, a good content, how it is written and read, its fields."""

    name: str
    content: Content
    encode: Callable[[Content], bytes]
    read: Callable[[Path], object]
    fields: dict[Place, Field]


class Change(NamedTuple):
    """A change of a good file, its bytes, and a word of the refusal; none: it may be read."""

    label: str
    data: Callable[[], bytes]
    word: str | None


# --- contents -------------------------------------------------------------------------------------


def encode_json(content: Content) -> bytes:
    deep = "[" * 1000 + "]" * 1000
    return json.dumps(content).replace(json.dumps(NESTED), deep).encode()


def encode_npz(content: Content) -> bytes:
    arrays = {name: value for name, value in content.items() if not name.endswith("header")}
    for name in content.keys() - arrays.keys():
        arrays[name] = np.array(encode_json(content[name]).decode())
    file = io.BytesIO()
    np.savez(file, allow_pickle=True, **arrays)
    return file.getvalue()


def encode_csv(content: Content) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(content)
    writer.writerows(zip(*(np.array(column, object).tolist() for column in content.values())))
    return text.getvalue().encode()


def encode_torch(content: Content) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def decode_npz(path: Path) -> Content:
    with np.load(path) as file:
        content = dict(file)
    headers = {name: json.loads(str(content[name])) for name in content if name.endswith("header")}
    return content | headers


def places(table: Any, content: Any, within: Place = ()) -> dict[Place, Field]:
    """Fields by their place in a content."""
    if isinstance(table, Field):
        return {within: table}
    if isinstance(table, list):
        return places(table[0], content[0], (*within, 0))
    found = {}
    for name in content:
        if name in table:
            found |= places(table[name], content[name], (*within, name))
        elif isinstance(table.get("*"), Field):
            found[(*within, name)] = replace(table["*"], required=False)
        elif "*" in table:
            found |= places(table["*"], content[name], (*within, name))
    return found


def described(
    name: str,
    content: Content,
    encode: Callable[[Content], bytes],
    read: Callable[[Path], object],
    table: Any,
) -> Format:
    """A format whose fields a table describes."""
    return Format(name, content, encode, read, places(table, content))


def checkpoint(folder: Path) -> tuple[Content, Callable[[Path], object]]:
    """The content of a checkpoint after one step of its optimizer, and how it is loaded."""
    net, task = obedient_net(BROKK_170), TaskConfig()
    config = PPOConfig(num_envs=2, horizon=2, threads=1)
    env = TaskVectorEnv(2, net, BROKK_170, task)
    about = describe_training(BROKK_170, net, task, config, True, 0)
    learner = make_learner(env, config, 0, critic=True)
    for parameter in learner.agent.parameters():
        parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
    learner.optimizer.step()
    log = TrainingLog(env, config, folder / "policy.npz", about, None)

    def load(path: Path) -> None:
        log.checkpoint = path
        log.load(learner)

    return torch.load(io.BytesIO(encode_torch(log.content(learner))), weights_only=True), load


def leaves(content: Any, within: Place = ()) -> dict[Place, Field]:
    """Places of a checkpoint that hold a value."""
    if not isinstance(content, dict):
        number = isinstance(content, torch.Tensor) and content.is_floating_point()
        return {within: Field("float" if number else "object")}
    found: dict[Place, Field] = {}
    for name, value in content.items():
        found |= leaves(value, (*within, name))
    return found


MACHINE = "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"


def encode_machine(content: Content) -> bytes:
    values = ", ".join(f"{name}={value!r}" for name, value in content.items())
    values = values.replace("nan", "float('nan')").replace("inf", "float('inf')")
    return f"{MACHINE}M = replace(BROKK_170, {values.replace(repr(NESTED), '[3]')})\n".encode()


def nets_and_policies() -> Iterator[Format]:
    """Files of weights."""
    table: dict[str, Any] = {"header": formats.NET_HEADER, **formats.NET_ARRAYS}
    for name, net in {"net.npz": random_net(), "shared.npz": shared_net()}.items():
        arrays = net_arrays(net)
        arrays["header"] = json.loads(str(arrays["header"]))
        yield described(name, arrays, encode_npz, load_net, table)
    table = {"header": formats.POLICY_HEADER, **formats.POLICY_ARRAYS}
    table |= {f"net_{name}": field for name, field in formats.NET_ARRAYS.items() if field.required}
    read = partial(load_policy, machine=BROKK_170)
    yield described("policy.npz", decode_npz(SHIPPED_POLICY), encode_npz, read, table)


def tables() -> Iterator[Format]:
    """Files of columns."""
    rng = np.random.default_rng(0)
    log = {"run": np.array(["x"] * 30), "time": np.arange(30) / 20}
    log |= {name: rng.uniform(-0.5, 0.5, 30) for name in ("u_a", "q_a", "q_dot_a")}
    table = {name: formats.LOG[name.removesuffix("a")] for name in log}
    table["q_dot_a"] = replace(table["q_dot_a"], required=False)
    for name, encode in {"log.csv": encode_csv, "log.npz": encode_npz}.items():
        yield described(name, log, encode, lambda path: read_log([path], 4), table)
    goals = {"sequence": ["up"] * 3, "time": [0.0, 1.0, 2.0]} | {f"v{x}": [0.1] * 3 for x in "xyz"}
    read = partial(read_commands, machine=BROKK_170)
    yield described("c.csv", goals, encode_csv, read, formats.COMMANDS)
    poses = {name: [q] * 3 for name, q in zip(BROKK_170.names, BROKK_170.q_start, strict=True)}
    read = partial(read_starts, machine=BROKK_170)
    yield described("s.csv", poses, encode_csv, read, formats.starts_of(BROKK_170))
    texts = {"when": ["now"] * 3, "task": ["box"] * 3, "mode": ["rl"] * 3}
    tried = texts | {name: [1.0, 2.0, 3.0] for name in Attempt._fields[3:]}
    kinds = {name: "text" if name in texts else "number" for name in tried}
    table = {name: Field(kind, shape=("rows",)) for name, kind in kinds.items()}
    yield described("attempts.csv", tried, encode_csv, read_attempts, table)


def results() -> Iterator[Format]:
    """Files of JSON."""
    net = load_policy(SHIPPED_POLICY, BROKK_170).net
    known = baselines(BROKK_170, net)
    gains = {"meta": gains_metadata(BROKK_170, net), "gains": gains_table(known)}
    table: Any = {"meta": formats.META, "gains": {"*": formats.GAINS}}
    read: Any = partial(read_gains, machine=BROKK_170, net=net)
    yield described("gains.json", gains, encode_json, read, table)
    mean = {"mean": 0.1, "low": 0.05, "high": 0.15}
    row: Any = dict.fromkeys(("velocity_error_all", "off_axis_drift_max", "valve_travel"), mean)
    sweep = {"meta": {"machine": "m", "actuator": "a"}, "table": {"rl": row, "pid": row}}
    yield described(
        "sweep.json", sweep, encode_json, partial(read_seeds, required={}), formats.SWEEP
    )
    row = {"controller": "rl", "sequence": "x", "start": 0, "kind": "workspace"}
    row |= dict.fromkeys(("velocity_rmse", "velocity_error_mean", "jerk_rms"), 0.1)
    row |= dict.fromkeys(("off_axis_drift_max", "valve_travel"), 0.2)
    meta = {"machine": "brokk170", "seed": 0, "plant": "analytic", "starts": "2"}
    meta["policy"] = str(SHIPPED_POLICY)
    runs = {"meta": meta, "starts": [BROKK_170.q_start], "runs": [row]}
    read = partial(read_results, BROKK_170, controllers=["rl"])
    yield described("runs.json", runs, encode_json, read, formats.RESULTS)
    task = (BROKK_170, net, TaskConfig(), PPOConfig())
    scored = {"starts": 2, "sequences": [one.name for one in task_sequences(BROKK_170)]}
    seed = {"identity": describe_training(*task, False, 0) | scored, "runs": [row]}
    read = lambda path: run_seed(*task, False, path.parent, 2, 0)  # noqa: E731
    yield described("seed_0.json", seed, encode_json, read, formats.RUNS)
    member = {"seed": 0, "budget": asdict(QUICK), "free_run": {"q1": 0.1}, "dither": 0.03}
    member |= {"error": {"rl": 0.1, "pid": 0.2}, "best": {"rl": "pid"}}
    member |= {"on_nets": {"rl": 0.1}, "loaded": {"rl": 0.2}}
    read = lambda path: run_member(BROKK_170, 0, path.parent, QUICK)  # noqa: E731
    yield described("member.json", member, encode_json, read, formats.FAMILY_MEMBER)


def all_formats(folder: Path) -> Iterator[Format]:
    """Every format with a good content."""
    yield from (*nets_and_policies(), *tables(), *results())
    content, load = checkpoint(folder)
    yield Format("policy.npz.checkpoint", content, encode_torch, load, leaves(content))
    frames = {str(i): f"({i}.5) can0 18{i}#0001020304" for i in range(1, 9)}
    encode = lambda content: "".join(f"{line}\n" for line in content.values()).encode()  # noqa: E731
    yield Format("drive.log", frames, encode, lambda path: list(read_frames(path)), {})
    numbers = [f for f in fields(Machine) if "unit" in f.metadata]
    values = {f.name: getattr(BROKK_170, f.name) for f in numbers}
    low = {f.name: values.get(f.metadata["low"], f.metadata["low"]) for f in numbers}
    table = {f.name: Field("float", low[f.name], f.metadata["high"]) for f in numbers}
    find = lambda path: find_machine(f"{path}:M")  # noqa: E731
    yield described("machine.py", values, encode_machine, find, table)


# --- changes --------------------------------------------------------------------------------------


def with_value(content: Content, place: Place, value: Any) -> Content:
    """A copy of a content with another value at one place."""
    name, *rest = place
    result = content.copy()
    if rest:
        result[name] = with_value(content[name], tuple(rest), value)
    elif value is REMOVED:
        del result[name]
    else:
        result[name] = value
    return result


def bad_numbers(
    array: np.ndarray, field: Field, rng: np.random.Generator
) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays with one number that is not finite or out of the range."""
    low, high = float(field.low), float(field.high)
    for bad in (np.nan, np.inf, -np.inf, low - 1, high + 1 + abs(high)):
        if not np.isfinite(bad) or np.isfinite([low, high]).all():
            changed = array.astype(float)
            changed[tuple(rng.integers(array.shape))] = bad
            yield f"set to {bad}", changed


def bad_columns(column: Any, field: Field, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """Columns of a CSV, whose cells are all text."""
    *first, last = np.array(column).tolist()
    if field.kind in NUMBERS:
        yield "retyped to text", [*first, "a"]
        yield "retyped to complex", np.zeros(len(column), complex)
        yield from bad_numbers(np.array(column), field, rng)
    if field.kind in NUMBERS or field.low > 0:
        yield "cut", [*first, ""]
    if field.unique:
        yield "repeated", [last, *first[1:], last]


def bad_arrays(array: Any, field: Field, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """Arrays of NumPy."""
    other = np.zeros(array.shape) if field.kind == "text" else array.astype(str)
    yield "retyped to text", other
    yield "retyped to complex", np.zeros(array.shape, complex)
    yield "retyped to objects", array.astype(object)
    yield "reshaped", array[None]
    yield "cut", array[:-1]
    if field.kind in NUMBERS:
        yield from bad_numbers(array, field, rng)


def bad_tensors(value: Any, field: Field, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """Tensors of a checkpoint."""
    yield from {"retyped": "a", "reshaped": value[None], "nested": [[[]]]}.items()
    if field.kind == "float":
        yield "infinite", torch.full_like(value, rng.choice([np.nan, np.inf, -np.inf]))


def bad_values(value: Any, field: Field, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """Values of JSON and of Python."""
    yield "retyped", "a" if field.kind in NUMBERS or type(value) in (int, float) else 3
    yield "nested", NESTED
    yield "reshaped", [value]
    if field.kind in NUMBERS:
        yield from ((label, x.tolist()) for label, x in bad_numbers(np.array(value), field, rng))
    if field.unique:
        yield "repeated", [value[0], *value[:-1]]


def field_changes(form: Format, rng: np.random.Generator) -> Iterator[Change]:
    """Every field, changed in every way."""
    kinds = {np.ndarray: bad_arrays, torch.Tensor: bad_tensors}
    for place, field in form.fields.items():
        value: Any = form.content
        for name in place:
            value = value[name]
        bad = bad_columns if form.encode is encode_csv else kinds.get(type(value), bad_values)
        changes = [*[("removed", REMOVED)] * field.required, *bad(value, field, rng)]
        for label, other in changes:
            if form.encode is encode_machine and label in ("removed", "reshaped"):
                continue
            word = place[-1][:2] if label == "removed" else place[-1]  # of a log: u_<joint>
            if label in ("cut", "reshaped", "nested") or form.encode is encode_torch:
                word = ""
            encode = partial(form.encode, with_value(form.content, place, other))
            yield Change(f"{'.'.join(map(str, place))} {label}", encode, word)


def byte_change(data: bytes, rng: np.random.Generator) -> Change:
    """A region of bytes cut, flipped, zeroed, repeated, or junk put in."""
    start = int(rng.integers(len(data)))
    length = int(min(2 ** rng.uniform(0, 12), len(data) - start))
    region = np.frombuffer(data[start : start + length], np.uint8)
    junk = rng.integers(0, 256, length, np.uint8)
    what = str(rng.choice(["cut off", "cut out", "flipped", "zeroed", "put in", "repeated"]))
    new = {
        "cut out": b"",
        "flipped": (region ^ np.uint8(2 ** rng.integers(8))).tobytes(),
        "zeroed": bytes(length),
        "put in": junk.tobytes() + region.tobytes(),
        "repeated": 2 * region.tobytes(),
    }
    if what == "cut off":
        return Change(f"cut off at {start}", lambda: data[:start], None)
    changed = data[:start] + new[what] + data[start + length :]
    return Change(f"{length} bytes at {start} {what}", lambda: changed, None)


# --- reading --------------------------------------------------------------------------------------


class TooLong(BaseException):
    """Reading took longer than `SECONDS`."""


def out_of_time(*_: object) -> None:
    raise TooLong


def complaint(form: Format, change: Change, path: Path) -> str:
    """What is wrong with how a changed file is read; empty: nothing."""
    data = change.data()
    path.write_bytes(data)
    signal.alarm(SECONDS)
    try:
        form.read(path)
        found = "" if change.word is None else "read"
    except ValueError as error:
        text = str(error)
        found = "" if (change.word or "") in text else f"not named: {text}"
        if "\n" in text or len(text) > LONGEST or str(path) not in text:
            found = f"refused by: {text}"
    except BaseException as error:
        found = f"{type(error).__name__}: {error}"
    signal.alarm(0)
    return found if path.read_bytes() == data else "the file is another one now"


def check_format(form: Format, files: int, seed: int, folder: Path) -> list[str]:
    """Complaints about `files` bad files of a format: those of fields first, a sample if many."""
    rng = np.random.default_rng(seed)
    data = form.encode(form.content)
    path = folder / form.name
    complaints = []
    good = complaint(form, Change("good", lambda: data, None), path)
    form.read(path)
    changes = list(field_changes(form, rng))
    sample = rng.permutation(len(changes))[: max(files // 2, files - 200)]
    chosen = [changes[i] for i in sample]
    chosen += [byte_change(data, rng) for _ in range(files - len(chosen))]
    complaints += [good] if good else []
    for change in chosen:
        found = complaint(form, change, path)
        if found:
            complaints.append(f"{form.name}: {change.label}: {found[:400]}")
    print(f"{form.name}: {len(chosen)} files, {len(complaints)} complaints", flush=True)
    print(*complaints, sep="\n", end="\n" * bool(complaints), flush=True)
    return complaints


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=500, help="of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", default="", help="names that contain this text only")
    options = parser.parse_args()
    torch.set_num_threads(1)
    signal.signal(signal.SIGALRM, out_of_time)
    complaints = []
    with tempfile.TemporaryDirectory() as name:
        for form in all_formats(Path(name)):
            if options.format in form.name:
                pages = int(Path("/proc/self/statm").read_text().split()[0])
                limit = pages * resource.getpagesize() + MEMORY
                resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
                complaints += check_format(form, options.files, options.seed, Path(name))
    return bool(complaints)


if __name__ == "__main__":
    sys.exit(main())
