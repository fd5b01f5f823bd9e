# Functions of the other scripts that change the system, as root or with a sudo that asks nothing. POSIX sh.

as_root() {
    if [ "$(id -u)" = 0 ]; then
        "$@"
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        sudo -n "$@"
    else
        return 1
    fi
}

# Installs Debian packages; a small system may have no package lists yet, or old ones.
apt_install() {
    install="env DEBIAN_FRONTEND=noninteractive apt-get install -yq --no-install-recommends $1"
    command -v apt-get >/dev/null && { as_root $install || { as_root apt-get update -q && as_root $install; }; }
}
