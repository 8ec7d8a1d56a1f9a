#!/usr/bin/env bash
# Runs the tests with the versions of Ubuntu 24.04 (requirements/noble.txt), once per Python 3.11 and 3.12 that
# is found on this machine, each in a virtual environment of its own. PYTHON=/path tests with that one alone.
# Usage: [PYTHON=/path/to/python3.12] test_noble.sh [pytest arguments]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Prints an interpreter of the version given: one that can make virtual environments and build extensions.
find_python() {
    local candidate
    for candidate in "/usr/bin/python$1" "$(command -v "python$1" || true)" \
        "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
        if "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
}

if [ -n "${PYTHON:-}" ]; then
    found=("$PYTHON")
else
    mapfile -t found < <(find_python 3.11 && find_python 3.12)
fi
if [ ${#found[@]} = 0 ]; then
    echo "test-noble: Python 3.11 or 3.12 is needed and none was found; set PYTHON to the path of one" >&2
    exit 1
fi

failed=()
for python in "${found[@]}"; do
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    venv=.venv-noble-$version
    PYTHON=$python scripts/setup.sh "$venv" requirements/noble.txt
    echo "test-noble: Python $version ($python)"
    "$venv/bin/python" -m pytest -n $((($(nproc) * 3 + 1) / 2)) --maxprocesses 6 "$@" || failed+=("$version")
done
if [ ${#failed[@]} != 0 ]; then
    echo "test-noble: failed with Python ${failed[*]}" >&2
    exit 1
fi
