#!/bin/sh
# A browser without root's right to raise its priority, with which it would draw before the programs under test run.
if [ "$(id -u)" = 0 ] && command -v setpriv >/dev/null; then
    exec setpriv --bounding-set -sys_nice "$CHROMIUM" "$@"
fi
exec "$CHROMIUM" "$@"
