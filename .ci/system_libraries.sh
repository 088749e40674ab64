#!/bin/sh
# Install what a bare Debian lacks, if it may: Python's venv module, and the libraries of Open3D.
# usage: system_libraries.sh PYTHON 'LIBRARY ...' 'PACKAGE ...'
set -eu
python=$1
libraries=$2
packages=$3

wanted=
known=$( (ldconfig -p || /sbin/ldconfig -p) 2>/dev/null || true)
for library in $libraries; do
    case $known in
    *"$library"*) ;;
    *) wanted=$packages ;;
    esac
done
if ! "$python" -c 'import ensurepip' 2>/dev/null; then
    wanted="$wanted $(basename "$python")-venv"
fi
[ -n "$wanted" ] || exit 0

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    # A machine without network may still have what matters: go on and let the next step tell.
    # shellcheck disable=SC2086  # a list of words
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $wanted; } ||
        echo "could not install:$wanted" >&2
else
    echo "missing system packages; if something fails, run: apt-get install $wanted" >&2
fi
