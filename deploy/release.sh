#!/usr/bin/env bash
# Cuts a release: make release VERSION=X.Y.Z. Everything is done in a fresh clone; commit and tag come back only if the demo ran
# from the wheel in an empty environment. Nothing is pushed or uploaded.
set -euo pipefail
version=$1 python=$2 here=$PWD

[[ $version =~ ^[0-9]+\.[0-9]+\.[0-9]+$ ]] || { echo "expected a version such as 0.2.0; got $version" >&2; exit 2; }
[[ -z $(git status --porcelain) ]] || { echo "expected a clean tree; commit or remove what git status shows" >&2; exit 2; }
if git rev-parse --quiet --verify "refs/tags/v$version" >/dev/null; then
  echo "version $version exists already: its tag is v$version" >&2; exit 2
fi
branch=$(git symbolic-ref --short HEAD)

clone=$(mktemp -d)
trap 'rm -rf "$clone"' EXIT
git clone --quiet --branch "$branch" "$here" "$clone"
cd "$clone"
git config user.name "$(git -C "$here" config user.name)"
git config user.email "$(git -C "$here" config user.email)"

# The version stands in pyproject.toml; the files below are made from it.
sed -i "0,/^version = .*/s//version = \"$version\"/" pyproject.toml
sed -i "s/^version: .*/version: $version/" CITATION.cff
make PYTHON="$python" .venv/.installed-dev
.venv/bin/python -m towncrier build --yes --version "$version"
make openapi
git add --all
git commit --quiet --message "Release $version"

make lint
make PYTHON="$python" package
git tag --annotate "v$version" --message "heliopsf $version"

cd "$here"
git pull --quiet --ff-only "$clone" "$branch"
git fetch --quiet "$clone" "refs/tags/v$version:refs/tags/v$version"
rm -rf dist && cp -r "$clone/dist" dist
echo "released $version: the tag is v$version, the packages are in dist/. Next: git push --follow-tags, and twine upload dist/*"
