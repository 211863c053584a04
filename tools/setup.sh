#!/bin/sh
# Set-up of .venv: finds a Python, says which, and hands over to setup_env.py. The system's Python is only run, never
# changed. PYTHON=/path/to/python in the environment chooses one. With --find-python it stops there; other arguments go on
# to setup_env.py (--help lists them).
set -eu
cd -- "$(dirname -- "$0")/.."

say() { printf 'set-up: %s\n' "$*" >&2; }

find_only=
if [ "${1:-}" = --find-python ]; then find_only=yes; fi

if [ "$(uname -s)" != Linux ] || [ "$(uname -m)" != x86_64 ]; then
    say "the ROS 2 wheels exist for x86-64 Linux only, and this is $(uname -s) $(uname -m)."
    say "Install ROS 2 Jazzy for this machine and build with colcon instead: see README.md."
    exit 1
fi

# The second time, the environment's own Python does. -S: without site-packages, whose start-up hooks take time.
if [ -z "${PYTHON:-}${find_only}" ] && [ -x .venv/bin/python ] &&
    .venv/bin/python -I -S -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' 2>/dev/null; then
    exec .venv/bin/python -I -S tools/setup_env.py "$@"
fi

candidates() {
    if [ -n "${PYTHON:-}" ]; then
        printf '%s\n' "$PYTHON"
        return
    fi
    for version in 3.12 3.11; do
        # By name, and by path: pyenv's commands refuse versions other than the chosen one.
        for candidate in "python$version" "/usr/bin/python$version" "/usr/local/bin/python$version" \
            "${PYENV_ROOT:-${HOME:-}/.pyenv}/versions/$version".*/bin/"python$version"; do
            if command -v "$candidate" >/dev/null 2>&1; then printf '%s\n' "$candidate"; fi
        done
    done
    printf '%s\n' python3 python
}

rejected=
answer=
IFS='
'
for candidate in $(candidates); do
    path=$(command -v "$candidate" 2>/dev/null) || continue
    if answer=$("$candidate" -I tools/probe_python.py 2>/dev/null); then break; fi
    rejected="$rejected
set-up:   not $path: ${answer:-it does not run}"
    answer=
done

if [ -z "$answer" ]; then
    say "found no Python to use: 3.12 (best) or 3.11, with its modules venv and ensurepip and its headers.$rejected"
    say "On Debian and Ubuntu: apt-get install python3 python3-venv python3-dev g++ make libgl1"
    exit 1
fi
found=${answer#ok }
case ${PYTHON:-$found} in
3.11.*) say "Python 3.12 would be ROS 2 Jazzy's own, but none was found that works.$rejected" ;;
esac
say "Python ${found%% *} (${found#* })"
if [ -n "$find_only" ]; then exit 0; fi
exec "${found#* }" -I tools/setup_env.py "$@"
