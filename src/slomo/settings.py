"""slomo.toml: every parameter that can change a result, checked against the stages' `Config` records.

`[inputs]` names the user's files; every other section is named after a stage. An option on the command line that can
change a result is written here too, so that the file always says how the artifacts were made.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from slomo.errors import SlomoError, UsageError
from slomo.store import replace_file

FILE = "slomo.toml"
INPUTS = {
    "clip": "video that `slomo reconstruct` reads",
    "masks": "folder of the user's own masks, one image a frame",
    "weights": "U2-Net-p weights (.onnx); else looked up, see `slomo doctor`",
    "prior": "network of slomo's own (.onnx) for the skeleton, instead of the one that comes with it",
    "keypoints2d": "your own 2-D key points (.json) of some frames of the clip, see docs/prior.md",
    "keypoint_model": "any network of 2-D key points (.onnx)",
    "keypoint_map": "how that network is fed and what its numbers mean (.toml)",
    "skeleton": "kinematic skeleton (.toml) instead of a built-in one",
    "keypoints": "key points that `slomo import` reads instead of a clip",
    "terrain": "ground that `slomo retarget` puts the motion on (.json), see docs/retarget.md",
    "deploy_log": "log of the last run of `slomo deploy`",
    "world": "ground of the simulation (.json) where it is not as planned, see docs/track.md",
    "truth": "truth.npz of a rendered clip, against which the report scores the reconstruction",
    "motion": "what `slomo retarget` starts from when there are both: reconstruct or import",
}
Tables = dict[str, dict[str, Any]]


def unknown(what: str, name: str, valid: list[str], *, where: object) -> UsageError:
    """`no <what> 'nmae' (valid: ...); did you mean 'name'?`"""
    close = difflib.get_close_matches(name, valid, 1)
    return UsageError(
        f"no {what} {name!r}", where=where, valid=valid, todo=f"did you mean {close[0]!r}?" if close else ""
    )


def read(root: Path, sections: list[str]) -> Tables:
    """The file's tables, or none where there is no file.

    Args:
        sections: the names that tables may have, beside `inputs`.

    Raises:
        UsageError: not TOML, or an unknown section or input.
    """
    path = root / FILE
    try:
        tables = tomllib.loads(path.read_bytes().decode())
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        todo = "correct it there, or move the file away: `slomo init` writes a new one"
        raise UsageError(f"is not TOML: {e}", where=path, todo=todo) from None
    except OSError as e:
        raise UsageError(f"cannot be read ({e.strerror})", where=path) from None
    return merge(tables, {}, sections, where=path)


def merge(tables: Tables, changes: Tables, sections: list[str], *, where: object) -> Tables:
    """`tables` with `changes` over them (value None: removed), their names checked.

    Raises:
        UsageError: an unknown section or input, or an input that is no string.
    """
    out: Tables = {}
    for name in tables | changes:
        if name not in ["inputs", *sections]:
            raise unknown("section", name, ["inputs", *sections], where=where)
        if not isinstance(tables.get(name, {}), dict):
            raise UsageError(f"{name} stands outside any section", where=where)
        table = tables.get(name, {}) | changes.get(name, {})
        out[name] = {k: v for k, v in table.items() if v is not None}
    for name, value in out.get("inputs", {}).items():
        if name not in INPUTS:
            raise unknown("input", name, list(INPUTS), where=f"{where} [inputs]")
        if not isinstance(value, str):
            raise UsageError(f"{name} must be a string, not {value!r}", where=f"{where} [inputs]")
    return out


def _tuples(x: Any) -> Any:
    return tuple(map(_tuples, x)) if isinstance(x, list) else x


def make(config: type, table: Mapping[str, Any], *, where: object) -> Any:
    """The record `config` with the values of `table` and its own defaults.

    Raises:
        UsageError: an unknown name (lists the valid ones), a wrong type (says what is expected), or a value that
            the record itself refuses.
    """
    from pydantic import TypeAdapter, ValidationError

    hints = get_type_hints(config)
    names = [f.name for f in fields(config)]
    for name in table:
        if name not in names:
            raise unknown("parameter", name, names, where=where)
    values = {f: getattr(config(), f) for f in names} | {k: _tuples(v) for k, v in table.items()}
    for name, value in values.items():
        try:
            values[name] = TypeAdapter(hints[name]).validate_python(value, strict=True)
        except ValidationError as e:
            problem = e.errors()[0]["msg"].removeprefix("Input should be ")
            raise UsageError(f"{name} = {value!r}: expected {problem}", where=where) from None
        if isinstance(value, float) and not abs(value) < float("inf"):
            raise UsageError(f"{name} = {value!r}: expected a finite number", where=where)
    try:
        return config(**values)
    except SlomoError as e:
        raise UsageError(str(e), where="" if e.where == str(where) else where) from None
    except (ValueError, TypeError) as e:
        raise UsageError(str(e), where=where) from None


def toml_value(x: Any) -> str:
    """`x` in TOML."""
    if isinstance(x, bool):
        return "true" if x else "false"
    if isinstance(x, int | float):
        return repr(x)
    if isinstance(x, str):
        escaped = re.sub(r'[\\"]', r"\\\g<0>", x)
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04X}" for c in escaped) + '"'
    if isinstance(x, list | tuple):
        return "[" + ", ".join(map(toml_value, x)) + "]"
    raise UsageError(f"a {type(x).__name__} cannot stand in {FILE}")


def parse_set(text: str) -> tuple[str, str, Any]:
    """(section, name, value) of `--set section.name=value`. Empty: remove it.

    The value is TOML, a number as people write it (".5"), or a bare word.
    """
    m = re.fullmatch(r"\s*(\w+)\.(\w+)\s*=(.*)", text, re.DOTALL)
    if not m:
        raise UsageError(f"{text!r} is not section.name=value", where="--set", todo="for example camera.fov_deg=60")
    section, name, value = m[1], m[2], m[3].strip()
    if not value:
        return section, name, None
    if re.fullmatch(r"[+-]?(\.\d+|\d+\.)([eE][+-]?\d+)?", value):
        return section, name, float(value)
    try:
        return section, name, tomllib.loads(f"x = {value}")["x"]
    except tomllib.TOMLDecodeError:
        return section, name, value


def edit(root: Path, changes: Tables) -> list[str]:
    """Write values into slomo.toml, keeping everything else in it as it is (value None: remove the entry).

    Returns:
        One line for each value that changed.

    Raises:
        UsageError: the file is written in a way that cannot be edited line by line.
    """
    path = root / FILE
    text = path.read_text() if path.exists() else ""
    old: Tables = tomllib.loads(text)
    want = {s: dict(t) for s, t in old.items()}
    said = []
    for section, values in changes.items():
        for name, value in values.items():
            before = old.get(section, {}).get(name)
            if before == value and type(before) is type(value):
                continue
            want.setdefault(section, {})[name] = value
            if value is None:
                del want[section][name]
            text = _set_line(text, section, name, value)
            was = "" if before is None else f" (was {toml_value(before)})"
            said.append(f"{FILE}: {section}.{name} = {'unset' if value is None else toml_value(value)}{was}")
    if said:
        if not _holds(text, want):
            raise UsageError("cannot be edited by line", where=path, todo=f"write there yourself: {'; '.join(said)}")
        replace_file(path, text.encode())
    return said


def _holds(text: str, want: Tables) -> bool:
    """Whether `text` is TOML with these tables, empty ones aside."""
    try:
        found = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    shown = [json.dumps({s: t for s, t in x.items() if t}, sort_keys=True, default=str) for x in (found, want)]
    return shown[0] == shown[1]  # as text, for nan is not equal to itself


def _set_line(text: str, section: str, name: str, value: Any) -> str:
    """`text` with one entry set: in place of its line, or of its commented line, or at the head of its section."""
    lines = text.splitlines()
    header = re.compile(rf"\s*\[\s*{section}\s*\]\s*(#.*)?")
    start = next((i + 1 for i, line in enumerate(lines) if header.fullmatch(line)), None)
    if start is None:
        lines += ["", f"[{section}]"] if lines else [f"[{section}]"]
        start = len(lines)
    end = next((i for i in range(start, len(lines)) if re.match(r"\s*\[", lines[i])), len(lines))
    entries = [i for i in range(start, end) if re.match(rf"\s*#?\s*{name}\s*=", lines[i])]
    entries.sort(key=lambda i: lines[i].lstrip().startswith("#"))
    comment = ""
    if entries and (m := re.search(r"\s{2}#[^\"']*$", lines[entries[0]])):
        comment = m[0]
    new = f"# {name} ={comment}" if value is None else f"{name} = {toml_value(value)}{comment}"
    if entries:
        lines[entries[0]] = new
    elif value is not None:
        lines.insert(start, new)
    return "\n".join(lines) + "\n"
