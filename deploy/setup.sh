#!/bin/sh
# setup.sh PYTHON EXTRA...: make .venv with this package and these extras, in the exact versions of constraints.txt, and with
# the hashes of requirements.lock where they hold. uv installs if it can be had, because pip takes ten times as long. torch,
# which only tests and studies need, comes by pip, which a machine may give a folder or an index of builds without CUDA.
set -eu
python=$1
shift
bin=.venv/bin
"$python" -m venv .venv # also if it is there: without python3-venv it is made without pip
mkdir -p build
pip() { $bin/python -m pip --disable-pip-version-check "$@"; }
is_locked() { # requirements.lock is of CPython 3.11 on Linux, x86_64
    $bin/python -c 'import sys, platform as p; sys.exit((sys.version_info[:2], p.system(), p.machine()) != ((3, 11), "Linux", "x86_64"))'
}

if is_locked; then
    how="--require-hashes --no-deps"
    list() { $bin/python deploy/requirements.py --locked "$@"; }
else
    how="--constraint constraints.txt"
    list() { $bin/python deploy/requirements.py "$@" | grep -v '^torch'; }
fi
# Python compiles the files that it imports, a sixth of all, and keeps them; if it may not, all are compiled now.
if [ -n "${PYTHONDONTWRITEBYTECODE:-}" ]; then kept=--compile-bytecode compile=--compile; else kept= compile=--no-compile; fi
index=$(pip config list | sed -n "s/^.*\.index-url='\(.*\)'$/\1/p" | tail -n 1)
[ -z "$index" ] || export UV_DEFAULT_INDEX="${UV_DEFAULT_INDEX:-$index}"
cert=$(pip config list | sed -n "s/^.*\.cert='\(.*\)'$/\1/p" | tail -n 1) # of a proxy, say
[ -z "$cert" ] || export SSL_CERT_FILE="${SSL_CERT_FILE:-$cert}"

list +dev =uv >build/uv.txt
list $(printf '+%s ' "$@") +build >build/wanted.txt
torch= # with --no-deps it is installed beside the others, and needs nothing of them
if $bin/python deploy/requirements.py $(printf '+%s ' "$@") | grep -q '^torch'; then
    torch="$bin/python -m pip --disable-pip-version-check install $compile --constraint constraints.txt torch"
    $torch --no-deps &
    beside=$!
    compiler=
    trap 'kill $beside $compiler 2>/dev/null || :' EXIT # a process in the background does not see Ctrl-C
    trap 'exit 130' INT TERM
fi
if ! { pip install --quiet $how --requirement build/uv.txt && $bin/uv pip install $kept --python $bin/python $how --requirement build/wanted.txt; }; then
    echo "uv did not install; pip does it, which takes longer."
    pip install $how --requirement build/wanted.txt
fi
if [ -n "$torch" ]; then # gemuco is compiled at its first start, which takes a minute, without torch: what is done meanwhile is kept
    nice "$bin/python" -m gemuco.warm >build/warm.log 2>&1 &
    compiler=$!
    wait $beside || :
    $torch # now with what it needs, if that is not there yet
fi
pip install --quiet --no-deps --no-build-isolation --editable .
