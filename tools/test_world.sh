#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Usage: tools/test_world.sh NAME...        (run by `make test-world`, from the repository's root)
#
# Tests integrations/NAME with the real libraries, each in an environment of its own below
# build/world. Prints its figures and a line for each, with the number of tests that passed. A test that is skipped
# is a failure, because all that a test needs is installed here.
#
#   PYTHON312=/path/to/python3.12     for ros2 and lerobot, which need this version; where there is none, they are
#                                     not tested, which is a failure with CI=true or OHMSKIN_NO_SKIP=1
set -uo pipefail

python_for() { # name
    local candidate
    case $1 in
        ros2 | lerobot)
            for candidate in "${PYTHON312:-}" python3.12 ~/.pyenv/versions/3.12*/bin/python3.12 \
                "$(command -v uv >/dev/null && uv python find 3.12 2>/dev/null)"; do
                [[ -n $candidate ]] || continue
                if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; then
                    echo "$candidate"
                    return
                fi
            done
            return 1
            ;;
        *) echo .venv/bin/python ;;
    esac
}

failed=0
for name in "$@"; do
    env=build/world/$name
    if ! python=$(python_for "$name"); then
        echo "test-world: $name: 0 passed: needs Python 3.12, and there is none (say PYTHON312=/path/to/python3.12)"
        [[ ${CI:-} != true && -z ${OHMSKIN_NO_SKIP:-} ]] || failed=1
        continue
    fi
    # What says what is installed has changed since.
    changed=$(find pyproject.toml integrations/"$name"/{pyproject.toml,setup.py} -newer "$env/.stamp" 2>&1 | grep -v "setup.py.*No such")
    if [[ -n $changed ]]; then
        echo "test-world: $name: making $env with $("$python" --version)"
        "$python" -m venv --clear "$env" &&
            "$env/bin/pip" install --quiet -e . -e "integrations/$name[test]" 2>"$env/pip.log" &&
            touch "$env/.stamp" || {
            tail -5 "$env/pip.log"
            echo "test-world: $name: 0 passed: its libraries could not be installed"
            failed=1
            continue
        }
    fi
    said=$(env -u PYTHONPATH PYTHONPATH=tests/helpers OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
        "$env/bin/python" -m pytest --rootdir "integrations/$name" -c "integrations/$name/pyproject.toml" \
        "integrations/$name" -s 2>&1)
    code=$?
    summary=$(tail -1 <<<"$said")
    if ((code)) || grep -q skipped <<<"$summary"; then
        echo "$said"
        failed=1
    fi
    grep -o "figure: .*" <<<"$said"
    echo "test-world: $name: $summary"
done
exit $failed
