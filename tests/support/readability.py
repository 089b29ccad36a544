"""Print figures of readability by folder: `python -m tests.support.readability [folder ...]`."""

import ast
import sys
from collections import Counter
from pathlib import Path

FOLDERS = ("model", "mpc", "protocol", "agent", "plant", "coordinator", "deploy", "transport")
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


def figures(path: Path) -> Counter[str]:
    """Count assignments, pairs of unrelated values, blank lines and large functions of a file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    tree = ast.parse("\n".join(lines))
    count: Counter[str] = Counter()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            pair = isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)
            count.update(assignments=1, pairs=pair)
        elif isinstance(node, FUNCTION):
            first = node.body[ast.get_docstring(node) is not None :]
            body = lines[first[0].lineno - 1 : node.end_lineno] if first else []
            inside = [word for word in ast.walk(node) if isinstance(word, ast.Name)]
            local = {word.id for word in inside if isinstance(word.ctx, ast.Store)}
            arguments = {a.arg for a in ast.walk(node.args) if isinstance(a, ast.arg)}
            count.update(body=len(body), blank=sum(not line.strip() for line in body))
            count.update(locals=len(local) > 15, arguments=len(arguments - {"self", "cls"}) > 6)
    return count


if __name__ == "__main__":
    for folder in sys.argv[1:] or FOLDERS:
        total: Counter[str] = Counter()
        for path in Path(folder).rglob("*.py"):
            total.update(figures(path))
        pairs = f"{total['pairs'] / total['assignments']:6.1%} pairs"
        blank = f"{total['blank'] / total['body']:6.1%} blank"
        large = f"functions of > 15 locals {total['locals']}, > 6 arguments {total['arguments']}"
        sys.stdout.write(f"{folder:<12}{pairs}, {blank}, {large}\n")
