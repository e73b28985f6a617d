#!/bin/sh
# install.sh [--target FOLDER] WORDS...: install into /opt/gemuco what deploy/requirements.py prints for these words, or
# with the word `.` this package itself; then take away what no service ever reads. Every file has a hash in
# requirements.lock.
set -eu
site=$(/opt/gemuco/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
target=""
if [ "${1:-}" = --target ]; then target=$2; shift 2; fi
folder=${target:-$site}
pip="python -m pip --python /opt/gemuco/bin/python install --quiet"
[ -z "$target" ] || pip="$pip --no-compile --target $target" # trained with once, so not worth the space

hashed() { [ "$(uname -m)" = x86_64 ]; } # the lock has no hashes for other processors

# list WORDS...: what pip is to install.
list() {
    if hashed; then
        python deploy/requirements.py --locked "$@" >/tmp/wanted.txt
        how="--require-hashes --no-deps"
    else
        python deploy/requirements.py "$@" >/tmp/wanted.txt
        how="--constraint constraints.txt"
    fi
}

if [ "${1:-}" = . ]; then
    list +build =setuptools
    python -m pip install --quiet --target /tmp/build $how --find-links wheels --requirement /tmp/wanted.txt
    PYTHONPATH=/tmp/build $pip --no-deps --no-index --no-build-isolation .
else
    list "$@"
    if $pip --no-index --find-links wheels $how --requirement /tmp/wanted.txt 2>/tmp/offline.log; then
        echo "installed from wheels/ alone"
    else
        grep -h ERROR /tmp/offline.log || true
        echo "wheels/ is not complete: asking the registry"
        $pip --find-links wheels $how --requirement /tmp/wanted.txt
    fi
fi

# Tests, headers, static libraries and pybullet's models of other people's robots.
for one in numpy matplotlib mpl_toolkits; do
    [ ! -d "$folder/$one" ] || find "$folder/$one" -type d -name tests -prune -exec rm -rf {} +
done
rm -rf "$folder/pybullet_data" "$folder/pybullet_envs" "$folder/pybullet_examples" "$folder/pybullet_robots" \
    "$folder/pybullet_utils"
find "$folder" -name '*.a' -delete
if [ -n "$target" ]; then # what the other folder has already, in the same version
    for one in "$target"/*.dist-info; do
        name=$(basename "$one")
        if [ -d "$site/$name" ]; then
            sed 's/,.*//' "$one/RECORD" | while read -r file; do rm -f "$target/$file"; done
            rm -rf "$one"
        fi
    done
    find "$target" -type d -empty -delete
fi
du -sh "$folder"
