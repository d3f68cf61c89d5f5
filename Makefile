# Two commands do everything: make demo, make test.
VENV ?= .venv

.PHONY: demo test setup lock
demo: setup
	$(VENV)/bin/splatpress demo --out demo-output --overwrite

test: setup
	$(VENV)/bin/python -m pytest

setup:
	@deploy/setup.sh $(VENV)

COMPILE = uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock"

# deploy/requirements.lock is the same without what only tests need: for the image. After a change of pyproject.toml's dependencies; needs uv.
lock:
	$(COMPILE) --extra dev --output-file requirements.lock
	$(COMPILE) --constraint requirements.lock --output-file deploy/requirements.lock
