"""What code does, as text: without comments, docstrings and layout, in which the same code may be written.

The first stage of `dvc.yaml` takes the digest of that (`pipeline.py`), and the others hang on it in place of the code
itself: a sentence in a docstring makes no result stale, a changed statement does.
"""

import ast
import hashlib
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


def digest(file: Path) -> str:
    """Identify what the code in a file does; a file of another kind as it is."""
    content = bare(file.read_text()).encode() if file.suffix == ".py" else file.read_bytes()
    return hashlib.sha256(content).hexdigest()
