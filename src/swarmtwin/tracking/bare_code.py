"""What code does, as text: without comments, docstrings and layout, in which the same code may be written.

The first stage of `dvc.yaml` writes it (`python -m swarmtwin.tracking.bare_code SOURCE OUTPUT`), and the others hang on
that in place of the code itself: a sentence in a docstring makes no result stale, a changed statement does.
"""

import ast
import sys
from pathlib import Path


class _WithoutTexts(ast.NodeTransformer):
    """Takes out the statements that are nothing but a text."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and not node.body:
            node.body = [ast.Pass()]
        return node


def bare(code: str) -> str:
    """Return Python code as its syntax tree is written: two texts are equal where the trees are, but for docstrings."""
    return ast.unparse(_WithoutTexts().visit(ast.parse(code))) + "\n"


def write_bare_code(source: Path, output: Path) -> None:
    """Write what the code in a folder does into another, file by file; files of other kinds as they are."""
    for file in sorted(source.rglob("*")):
        if file.is_dir() or "__pycache__" in file.parts:
            continue
        place = output / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(bare(file.read_text()).encode() if file.suffix == ".py" else file.read_bytes())


if __name__ == "__main__":
    write_bare_code(*map(Path, sys.argv[1:]))
