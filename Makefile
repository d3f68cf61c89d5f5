# Two commands do everything: make demo, make test.
VENV ?= .venv
WORKERS = --numprocesses 3 --dist loadfile --no-loadscope-reorder

.PHONY: demo test coverage setup lock
demo: setup
	$(VENV)/bin/splatpress demo --refresh

test:
	@deploy/setup.sh $(VENV) with-tests
	$(VENV)/bin/python -m pytest $(WORKERS)

# Which lines of the four packages no test runs in its own process; a quarter slower than `make test`.
coverage:
	@deploy/setup.sh $(VENV) with-tests
	$(VENV)/bin/python -m pytest $(WORKERS) $(foreach room,storage pipeline renderer services,--cov=$(room)) --cov-report=term:skip-covered

setup:
	@deploy/setup.sh $(VENV)

COMPILE = uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock"

# deploy/requirements.lock is the same without what only tests need: for the image. After a change of pyproject.toml's dependencies; needs uv.
# wheels.txt names the wheels that the locked packages have, for the Pythons and processors that README names.
lock:
	$(COMPILE) --extra dev --output-file requirements.lock
	$(COMPILE) --extra evaluate --constraint requirements.lock --output-file deploy/requirements.lock
	uv pip compile requirements.lock --universal --python-version 3.11 --format pylock.toml --quiet \
		| python3 deploy/wheels.py >deploy/wheels.txt
