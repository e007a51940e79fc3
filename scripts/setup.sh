#!/usr/bin/env bash
# Make the virtual environment named by the first argument, and see to libLLVM.
set -euo pipefail
venv=$1
python=${PYTHON:-python3}

if ! "$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))'; then
  echo "error: Python 3.10 to 3.13 is needed, $("$python" --version) was found; set PYTHON=..." >&2
  exit 2
fi

as_root() { if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"; else
  echo "error: run as root: $*" >&2; exit 2; fi; }

if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
  if command -v apt-get >/dev/null; then as_root apt-get update -qq; as_root apt-get install -y -qq python3-venv
  else echo "error: this Python has no venv module; install it" >&2; exit 2; fi
fi
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --editable '.[dev]'

# exit 0 when Dr.Jit finds a libLLVM that is new enough, or a GPU
usable() { "$venv/bin/appearance-opt" doctor >/dev/null 2>&1; }

if ! usable; then
  echo "libLLVM was not found: installing it through the system's package manager"
  if command -v apt-get >/dev/null; then
    as_root apt-get update -qq
    # the newest that this distribution has
    package=$(apt-cache search --names-only '^libllvm[0-9]+(\.[0-9])?(t64)?$' | awk '{print $1}' | sort -V | tail -n 1)
    as_root apt-get install -y -qq "${package:-libllvm19}"
  elif command -v dnf >/dev/null; then as_root dnf install -y -q llvm-libs
  elif command -v brew >/dev/null; then brew install --quiet llvm
  elif command -v pacman >/dev/null; then as_root pacman -S --noconfirm llvm-libs
  fi
fi
usable || { "$venv/bin/appearance-opt" doctor; exit 2; }
