# Verbs of daily work; `just` lists them. Each is one line, so they can be typed without just as well.

python := ".venv/bin/python"

# list the verbs
default:
    @just --list

# environment with everything for development
install:
    python3 -m venv .venv
    .venv/bin/pip install -c constraints.txt -e ".[dev]"

# style, layers, types
check:
    .venv/bin/ruff check .
    .venv/bin/ruff format --check .
    .venv/bin/lint-imports
    .venv/bin/pyright --pythonpath {{python}}

# format and repair what can be repaired
format:
    .venv/bin/ruff check --fix .
    .venv/bin/ruff format .

# tests; arguments go to pytest
test *arguments:
    .venv/bin/pytest -n auto {{arguments}}

# tests that take long
test-slow:
    .venv/bin/pytest -n auto -m slow

# kernels as plain Python: real tracebacks, real coverage
test-plain:
    NUMBA_DISABLE_JIT=1 .venv/bin/pytest -n auto -m "kernels and not compiled and not slow"

# damaged files of every format, 100 000 by default; arguments go to the harness
hostile *arguments="--cases 100000":
    {{python}} tests/hostile/_runner.py {{arguments}}

# documentation, warnings are errors
docs:
    .venv/bin/sphinx-build -W --keep-going -b html docs docs/_build/html

# measurements, then the comparison with the committed baseline
bench *arguments:
    {{python}} benchmarks/run.py {{arguments}}
    {{python}} benchmarks/check.py

# forget compiled kernels
fresh:
    rm -rf .cache
    find src -name "*.nb[ci]" -delete

# everything, in an environment of its own
ci:
    .ci/run
