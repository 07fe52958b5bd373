"""How the house stands: long files, names that mean two things, lists that others write into, numerics in Python.

    python benches/house.py            # this tree
    python benches/house.py --list     # with the places

Counts are of `crates/` and `python/`, without tests. Circles of the core's modules are refused by `make check`, upward
arrows of the package by `lint-imports`.
"""

from __future__ import annotations

import argparse
import ast
import collections
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE, CORE = ROOT / "python" / "weldscan", ROOT / "crates" / "weldcore" / "src"
LONG = 600
# What keeps numerics in Python, by room (docs/decisions): what touches every shot may stay, every point may not.
KEPT_BY = {
    "calibration": "0009, 0012: tens of unknowns, hundreds of rows",
    "measure": "0020: per shot and bin",
    "verification": "0020: per sphere, plane and probed point",
    "simulated": "0020: scenes are set up here, rendered in the core",
    "report": "0020: pictures",
}
TYPE = re.compile(r"^\s*(?:pub(?:\([a-z]+\))? )?(?:struct|enum|trait) ([A-Z]\w+)", re.M)


def sources() -> list[Path]:
    """Every source file of core and package."""
    found = [*CORE.rglob("*.rs"), *PACKAGE.rglob("*.py")]
    return sorted(path for path in found if "tests" not in path.stem)


def long_files() -> list[str]:
    """Files with more lines than a reader keeps in mind."""
    sizes = {path: len(path.read_text().splitlines()) for path in sources()}
    return [f"{path.relative_to(ROOT)}: {n}" for path, n in sorted(sizes.items(), key=lambda x: -x[1]) if n > LONG]


def names_twice() -> list[str]:
    """Types that are defined under one name in two files of one language; what the binding wraps is not one."""
    where = collections.defaultdict(set)
    for path in sources():
        room = path.suffix
        if path.suffix == ".rs":
            text = path.read_text().split("#[cfg(test)]")[0]
            room += "python" if "python" in path.relative_to(CORE).parts else ""
            names = TYPE.findall(text)
        else:
            names = [node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)]
        for name in names:
            where[room, name].add(str(path.relative_to(ROOT)))
    return [f"{name}: {', '.join(sorted(paths))}" for (_, name), paths in sorted(where.items()) if len(paths) > 1]


def loose_dicts() -> list[str]:
    """`dict[str, Any]` where no JSON is read or written: a record whose fields nobody has written down."""
    return [
        f"{path.relative_to(ROOT)}:{k}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for k, line in enumerate(path.read_text().splitlines(), 1)
        if "dict[str, Any]" in line and path.parent.name != "records"
    ]


def written_into_others() -> list[str]:
    """Appends to a list that came in as an argument or belongs to another object."""
    return [
        f"{path.relative_to(ROOT)}:{line}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line in _appends(ast.parse(path.read_text()))
    ]


def _appends(tree: ast.AST) -> Iterator[int]:
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        foreign = {argument.arg for argument in arguments} - {"self", "cls"}
        for node in ast.walk(function):
            target = None
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if node.func.attr in ("append", "extend"):
                    target = node.func.value
            elif isinstance(node, ast.AugAssign) and isinstance(node.value, ast.List | ast.ListComp | ast.Call):
                # A list, by the way it is written: sums of numbers are the object's own business.
                target = node.target if isinstance(node.target, ast.Attribute) else None
            depth = 0
            while isinstance(target, ast.Attribute):
                target, depth = target.value, depth + 1
            if isinstance(target, ast.Name) and (target.id in foreign or (target.id == "self" and depth > 1)):
                yield node.lineno


def numerics() -> dict[str, int]:
    """Lines that compute with arrays or angles, by room of the package."""
    count: collections.Counter[str] = collections.Counter()
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).parts
        room = parts[0] if len(parts) > 1 else "(top)"
        count[room] += len(re.findall(r"^(?!\s*(?:import|from|#)).*\b(?:np|math|cv2)\.\w", path.read_text(), re.M))
    return dict(count.most_common())


def main() -> int:
    """Print the counts."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--list", action="store_true", help="with the places")
    asked = options.parse_args()
    for title, found in (
        (f"files over {LONG} lines", long_files()),
        ("type names defined twice", names_twice()),
        ("dict[str, Any] outside records", loose_dicts()),
        ("appends to others' lists", written_into_others()),
    ):
        print(f"{title}: {len(found)}")
        if asked.list:
            print("".join(f"    {line}\n" for line in found), end="")
    print("lines of numerics in Python:")
    for room, lines in numerics().items():
        print(f"    {room:14}{lines:5}  {KEPT_BY.get(room, '')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
