# Two commands do everything: make demo, make test.
VENV ?= .venv

.PHONY: demo test setup lock
demo: setup
	$(VENV)/bin/splatpress demo --out demo-output --overwrite

test: setup
	$(VENV)/bin/python -m pytest

setup:
	@deploy/setup.sh $(VENV)

# After a change of pyproject.toml's dependencies; needs uv.
lock:
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-emit-find-links --custom-compile-command "make lock" --output-file requirements.lock
