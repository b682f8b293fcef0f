"""List the exercises, or check the answer to one of them.

python -m exercises          the list
python -m exercises 4        the verdict on exercise 4
"""

import ast
import importlib
import sys
from pathlib import Path

from exercises.verdict import judge

FILES = {int(path.stem[1:3]): path for path in Path(__file__).parent.glob("e[0-9][0-9]_*.py")}


def main(arguments: list[str]) -> int:
    """Exit status: 0 passed, 1 not yet, 2 wrong use."""
    if not arguments:
        for number, path in sorted(FILES.items()):
            title = (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]
            print(f"{number:2}  {title:64} {path.parent.name}/{path.name}")
        return 0
    if len(arguments) > 1 or not arguments[0].isdigit() or int(arguments[0]) not in FILES:
        print(f"expected a number from 1 to {len(FILES)}, got {' '.join(arguments)}")
        return 2
    path = FILES[int(arguments[0])]
    module = importlib.import_module(f"exercises.{path.stem}")
    error = judge(module)
    print(f"Not yet. {error}" if error else f"Passed. Now compare with {module.SOLUTION}.")
    return int(bool(error))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
