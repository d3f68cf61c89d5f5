#!/bin/sh
# The image without Docker and without a registry: Debian from its own archive by debootstrap, the rest by buildah from
# the same Dockerfile. As root, on Debian or Ubuntu with buildah and debootstrap:
#
#     deploy/build-image.sh [TAG] [OPTIONS OF buildah build]      # TAG: splatpress
#
# then `buildah push TAG docker-archive:splatpress.tar`, and `docker load`, `podman load` or `ctr images import` there.
set -eu
cd "$(dirname "$0")/.."
tag=${1:-splatpress}
[ $# -eq 0 ] || shift
base=localhost/debian:bookworm-slim
export BUILDAH_ISOLATION="${BUILDAH_ISOLATION:-chroot}"

if ! buildah inspect --type image "$base" >/dev/null 2>&1; then
    made=$(buildah from scratch)
    debootstrap --variant=minbase bookworm "$(buildah mount "$made")"
    buildah umount "$made"
    buildah commit --rm "$made" "$base"
fi
exec buildah build --from "$base" --format docker --file deploy/Dockerfile --tag "$tag" "$@" .
