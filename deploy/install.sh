#!/bin/sh
# install.sh [--target FOLDER] WORDS...: install into /opt/gemuco what deploy/requirements.py prints for these words, or
# with the word `.` this package itself, in the versions of constraints.txt; then take away what no service ever reads.
set -eu
site=$(/opt/gemuco/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
target=""
if [ "${1:-}" = --target ]; then target=$2; shift 2; fi
folder=${target:-$site}
pip="python -m pip --python /opt/gemuco/bin/python install --quiet --constraint constraints.txt --find-links wheels"
[ -z "$target" ] || pip="$pip --no-compile --target $target" # trained with once, so not worth the space

if [ "${1:-}" = . ]; then
    $pip --no-deps --no-index . 2>/tmp/offline.log || $pip --no-deps .
else
    python deploy/requirements.py "$@" >/tmp/wanted.txt
    if $pip --no-index --requirement /tmp/wanted.txt 2>/tmp/offline.log; then
        echo "installed from wheels/ alone"
    else
        grep -h ERROR /tmp/offline.log || true
        echo "wheels/ is not complete: asking the registry"
        $pip --extra-index-url "$TORCH_INDEX" --requirement /tmp/wanted.txt
    fi
fi

# Tests, headers, static libraries and pybullet's models of other people's robots.
for one in numpy matplotlib mpl_toolkits networkx sympy torch; do
    [ ! -d "$folder/$one" ] || find "$folder/$one" -type d -name tests -prune -exec rm -rf {} +
done
[ ! -d "$folder/torch/bin" ] || find "$folder/torch/bin" -type f ! -name torch_shm_manager -delete # torch asks for that one
rm -rf "$folder/torch/include" "$folder/torch/test" "$folder/torch/share" "$folder/pybullet_data" \
    "$folder/pybullet_envs" "$folder/pybullet_examples" "$folder/pybullet_robots" "$folder/pybullet_utils"
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
