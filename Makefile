.PHONY: check lint types layers test pins

check: lint types layers test

lint:
	uv run ruff check .
	uv run ruff format --check .

types:
	uv run pyright

layers:
	uv run lint-imports

test:
	uv run pytest -n auto

# The versions to paste into [tool.uv] constraint-dependencies, after removing the old ones there.
pins:
	uv export -q --upgrade --no-hashes --no-emit-project --no-header --no-annotate
