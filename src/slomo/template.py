"""A new project's slomo.toml: every parameter of every stage with its default and what it means."""

import ast
import fnmatch
import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slomo.settings import INPUTS, toml_value


def template(records: Mapping[str, tuple[str, str]], lenders: Mapping[str, str] | None = None) -> str:
    """The text of the file, all parameters commented out.

    Args:
        records: section -> (module, name of its record of parameters). They are read, not imported: that takes seconds.
        lenders: section -> the one whose parameters it shares; only what it has beside them is shown.
    """
    lenders = lenders or {}
    out = ["# Parameters of this slomo project. What is commented out shows the default.", "", "[inputs]"]
    out += [f'# {name} = ""  # {what}' for name, what in INPUTS.items()]
    for section, (module, name) in records.items():
        entries, shared = _entries(module, name), ""
        if lender := lenders.get(section):
            lent = {n for n, _, _ in _entries(*records[lender])}
            entries, shared = (
                [e for e in entries if e[0] not in lent],
                f"  # the rest is that of [{lender}], unless set here too",
            )
        out += ["", f"[{section}]{shared}"] if entries else []
        out += [f"# {n} = {toml_value(default)}" + (f"  # {about}" if about else "") for n, default, about in entries]
    return "\n".join(out) + "\n"


def _entries(module: str, name: str) -> list[tuple[str, Any, str]]:
    """Name, default and description of a record's fields, from its source; those of a record it extends first."""
    source = _source(module)
    body = ast.parse(source).body
    imported = [(a, n.module) for n in body if isinstance(n, ast.ImportFrom) for a in n.names]
    froms, modules = {a.name: m for a, m in imported}, {a.asname or a.name: f"{m}.{a.name}" for a, m in imported}
    if name in froms:
        return _entries(froms[name] or module, name)
    record = next(n for n in body if isinstance(n, ast.ClassDef) and n.name == name)
    inherited = []
    for base in record.bases:
        if isinstance(base, ast.Name):
            inherited += _entries(froms.get(base.id) or module, base.id)
        elif isinstance(base, ast.Attribute) and isinstance(base.value, ast.Name):
            inherited += _entries(modules[base.value.id], base.attr)
    fields = {
        n.target.id: n.value
        for n in record.body
        if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name) and n.value is not None
    }
    about = _described(ast.get_docstring(record) or "", fields)
    lines = source.splitlines()
    for field, value in fields.items():
        if comment := lines[(value.end_lineno or 1) - 1][value.end_col_offset :].partition("#")[2].strip():
            about[field] = comment
    own = [(field, _value(value, body, froms), about.get(field, "")) for field, value in fields.items()]
    return [entry for entry in inherited if entry[0] not in fields] + own


def _value(node: ast.expr, body: list[ast.stmt], froms: Mapping[str, str | None]) -> Any:
    """What an expression stands for: a literal, or `tuple(NAME)` of one of this module or of the one it is from."""
    if not (isinstance(node, ast.Call) and isinstance(node.args[0], ast.Name)):
        return ast.literal_eval(node)
    name = node.args[0].id
    if module := froms.get(name):
        body = ast.parse(_source(module)).body
    given = next(n.value for n in body if isinstance(n, ast.Assign) and name in map(ast.unparse, n.targets))
    return tuple(ast.literal_eval(given))


def _source(module: str) -> str:
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"no module {module}")
    return Path(spec.origin).read_text()


def _described(docstring: str, fields: Mapping[str, Any]) -> dict[str, str]:
    """Field -> text of `field: text`, `field, field: text` or `fie*: text` in the docstring's list of attributes."""
    text = " ".join(docstring.partition("Attributes:\n")[2].split("\n\n")[0].split())
    name = "(?:" + "|".join([*fields, r"\w+\*"]) + ")"
    parts = re.split(rf"(?:^|(?<=[.;] ))({name}(?:, {name})*): ", text)
    found: dict[str, str] = {}
    for names, meaning in zip(parts[1::2], parts[2::2], strict=True):
        for pattern in names.split(", "):
            # What points into the source is not for who reads slomo.toml.
            told = re.sub(r" \(see `[\w.]+`\)", "", meaning).strip().rstrip(".;")
            found |= dict.fromkeys(fnmatch.filter(fields, pattern), told)
    return found
