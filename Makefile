.PHONY: check lint types layers test

check: lint types layers test

lint:
	uv run ruff check .
	uv run ruff format --check .

types:
	uv run pyright

layers:
	uv run lint-imports

test:
	uv run pytest
