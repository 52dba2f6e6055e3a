"""Writes completion/emb-daemon.bash from the commands' own parsers.

python docs/completion.py            writes it
python docs/completion.py --check    exit status 1 if it is not current
"""

import argparse
import importlib.util
import sys
from pathlib import Path

from emb_daemon.cli.main import COMMANDS

_FILE = Path(__file__).parent.parent / "completion" / "emb-daemon.bash"
_HEAD = """\
# bash completion for emb-daemon: install -m 644 emb-daemon.bash /usr/share/bash-completion/completions/emb-daemon
_emb_daemon() {
    local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]} options=
    COMPREPLY=()
    if ((COMP_CWORD == 1)); then
        mapfile -t COMPREPLY < <(compgen -W "%s --help --version" -- "$word")
        return
    fi
    case $before in
        --corner) mapfile -t COMPREPLY < <(compgen -W "FL FR RL RR" -- "$word"); return ;;
        -c | --channel) mapfile -t COMPREPLY < <(compgen -W "$(command ls /sys/class/net)" -- "$word"); return ;;
        -i | --interface) mapfile -t COMPREPLY < <(compgen -W "socketcan udp_multicast virtual" -- "$word"); return ;;
    esac
    case ${COMP_WORDS[1]} in
"""
_TAIL = """\
    esac
    if [[ $word == -* ]]; then
        mapfile -t COMPREPLY < <(compgen -W "$options --help" -- "$word")
    else
        mapfile -t COMPREPLY < <(compgen -f -- "$word")
    fi
}
complete -o filenames -F _emb_daemon emb-daemon
"""


def _options(command: str) -> list[str]:
    parser = argparse.ArgumentParser(add_help=False)
    importlib.import_module(f"emb_daemon.cli.{command}").add_arguments(parser)
    return [option for action in parser._actions for option in action.option_strings]


def text() -> str:
    cases = [f'        {command}) options="{" ".join(_options(command))}" ;;\n' for command in COMMANDS if _exists(command)]
    return _HEAD % " ".join(filter(_exists, COMMANDS)) + "".join(cases) + _TAIL


def _exists(command: str) -> bool:
    return importlib.util.find_spec(f"emb_daemon.cli.{command}") is not None


if __name__ == "__main__":
    if "--check" in sys.argv[1:]:
        sys.exit(int(not _FILE.is_file() or _FILE.read_text() != text()))
    _FILE.write_text(text())
