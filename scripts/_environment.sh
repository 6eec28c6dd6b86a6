# Sourced by the other scripts: makes .venv and installs what is missing, system packages where that is allowed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

need_system_packages() {
    local missing=()
    for package in "$@"; do
        dpkg -s "$package" >/dev/null 2>&1 || missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && return
    if ! command -v apt-get >/dev/null; then
        echo "please install: ${missing[*]}" >&2
    elif [ "$(id -u)" -eq 0 ]; then
        apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "${missing[@]}" >/dev/null
    elif sudo -n true 2>/dev/null; then
        sudo apt-get update -qq && sudo apt-get install -y -qq "${missing[@]}" >/dev/null
    else
        echo "please run: sudo apt-get install ${missing[*]}" >&2
    fi
}

# $1: extras of rnd-avatar to install, such as dev
need_python_packages() {
    local python=${PYTHON:-python3}
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
        echo "Python 3.11 or newer is needed; PYTHON=... names one" >&2
        exit 1
    }
    [ -x .venv/bin/python ] || "$python" -m venv .venv 2>/dev/null || {
        need_system_packages python3-venv
        "$python" -m venv .venv
    }
    # shellcheck disable=SC1091
    source .venv/bin/activate
    local stamp full
    stamp=".venv/installed-$1-$(sha256sum pyproject.toml | cut -c1-16)"
    full=${stamp/installed-$1-/installed-dev-} # has every other extra too
    [ -e "$stamp" ] || [ -e "$full" ] && return
    # torch first and by version: the plain name would bring gigabytes of CUDA to a machine without a GPU
    python -c 'import torch' 2>/dev/null || install_cpu_torch
    pip install --quiet --editable ".[$1]"
    touch "$stamp"
}

install_cpu_torch() {
    local index=${RND_TORCH_INDEX:-}
    if [ -n "$index" ]; then
        pip install --quiet "torch==2.13.0" --index-url "$index"
    else
        pip install --quiet "torch==2.13.0"
    fi
}

# viewer/web/dist, the page that needs no server; and axe-core, for tests
need_web_page() {
    command -v npm >/dev/null || need_system_packages npm
    local stamp
    stamp="viewer/web/node_modules/installed-$(sha256sum viewer/web/package-lock.json | cut -c1-16)"
    if [ -e "$stamp" ] || (cd viewer/web && npm ci --silent --no-audit --no-fund); then
        touch "$stamp"
        (cd viewer/web && npm run --silent build)
    else
        echo "npm's packages cannot be fetched; tests of the static page and of accessibility are skipped" >&2
    fi
}

# splat-transform on the PATH, for the tests that read our splats with it (200 MB of node_modules)
need_splat_transform() {
    command -v splat-transform >/dev/null && return
    command -v npm >/dev/null || need_system_packages npm
    local version=2.7.1 # the last for Node.js 20
    local folder=$PWD/.cache/splat-transform-$version
    [ -x "$folder/node_modules/.bin/splat-transform" ] ||
        npm install --silent --no-audit --no-fund --prefix "$folder" "@playcanvas/splat-transform@$version" ||
        echo "splat-transform cannot be installed; its tests are skipped" >&2
    export PATH=$folder/node_modules/.bin:$PATH
}
