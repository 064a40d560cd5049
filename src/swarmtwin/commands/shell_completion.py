"""`swarmtwin --shell-completion install=bash`: commands by their names, and their options by Hydra's completion."""

import os

from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.errors import UserError

SCRIPT = """_swarmtwin_completion() {
    local line="${COMP_LINE:0:$COMP_POINT}"
    local choices="$(COMP_LINE="$line" "${COMP_WORDS[0]}" --shell-completion query=bash 2>/dev/null)"
    COMPREPLY=($(compgen -W "$choices" -- "${COMP_WORDS[COMP_CWORD]}"))
}
COMP_WORDBREAKS=${COMP_WORDBREAKS//=}
complete -o nospace -o default -F _swarmtwin_completion swarmtwin
"""
"""What bash is to evaluate; zsh does likewise after `autoload -U bashcompinit && bashcompinit`."""


def complete(arguments: list[str]) -> tuple[str, list[str]] | None:
    """Answer what a shell asks for, and return the command, with arguments, that has to answer; None where none has to.

    Args:
        arguments: after `--shell-completion`: `install=bash`, which prints the script; or `query=bash`, which the
            script calls with the line that is typed in the variable COMP_LINE.

    Raises:
        UserError: it is another shell, or no question.
    """
    if arguments == ["install=bash"]:
        print(SCRIPT)
        return None
    if arguments != ["query=bash"]:
        raise UserError('write eval "$(swarmtwin --shell-completion install=bash)"; of shells there is bash')
    _, _, typed = os.environ.get("COMP_LINE", "").lstrip().partition(" ")
    name, space, options = typed.lstrip().partition(" ")
    if not space:
        print(" ".join(command for command in COMMANDS if command.startswith(name)))
        return None
    if name not in COMMANDS:
        return None
    os.environ["COMP_LINE"] = f"swarmtwin-{name} {options}"  # as the command's own application would be called
    return name, ["--shell-completion", "query=bash"]
