"""Functions compiled to machine code by numba, kept between processes and compiled anew when any of them changes."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from platformdirs import user_cache_path

Function = Callable[..., Any]


def compiled(function: Function) -> Function:
    """Compile a function of arrays and numbers when it is first called; it runs without Python's global lock.

    What may be reordered in floating point is: results are those of the plain formulas to rounding, and the same on one
    machine from run to run. Division by zero gives infinities, and indices are not checked. Called from another
    compiled function it becomes a part of that.

    numba keeps what it compiled, but sees only whether the function's own file changed, not one whose functions it
    calls: so the machine code lies in a folder named after all of the package's compiled sources.
    """
    settings: Any = numba.config
    folder, settings.CACHE_DIR = settings.CACHE_DIR, settings.CACHE_DIR or str(_cache_folder())
    try:
        decorate = numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy", forceinline=True)
        return decorate(function)
    finally:
        settings.CACHE_DIR = folder


@cache
def _cache_folder() -> Path:
    sources = [path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py"))]
    digest = hashlib.sha256(b"\0".join(source for source in sources if b"@compiled" in source)).hexdigest()
    return user_cache_path("swarmtwin") / "compiled" / digest[:16]
