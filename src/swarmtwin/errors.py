"""The one exception a user ever sees: what is wrong, where, and what to do."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Something the user can put right: its message names what is wrong, where, and the remedy."""


class RefusedError(UserError):
    """An answer that is "no", such as a gate's: nothing was wrong with the question."""


def near_miss(word: str, known: Iterable[str]) -> str:
    """Return a remedy for an unknown `word`: the known word meant, if one is near, and all known words."""
    known = sorted(known)
    close = difflib.get_close_matches(word, known, n=5, cutoff=0.6)
    close.sort(key=lambda name: sorted(name) != sorted(word))  # the same letters in another order before others
    meant = f"did you mean {close[0]!r}? " if close else ""
    return f"{meant}known: {', '.join(known) or 'none'}"
