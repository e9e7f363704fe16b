.PHONY: check lint types layers test browser pins

check: lint types layers browser test

lint:
	uv run ruff check .
	uv run ruff format --check .

types:
	uv run pyright

layers:
	uv run lint-imports

test:
	uv run pytest -n auto

# Pages are tested in Chromium: where it is missing and may be installed, it is.
browser:
	@command -v chromium >/dev/null || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
		&& apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -yq \
		--no-install-recommends chromium fonts-dejavu-core; } \
		|| echo "no chromium here: the tests of pages are skipped"

# The versions to paste into [tool.uv] constraint-dependencies, after removing the old ones there.
pins:
	uv export -q --upgrade --no-hashes --no-emit-project --no-header --no-annotate
