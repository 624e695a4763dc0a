# make render: an image of a real scene.  make test: the tests.  Both set up .venv first.

PYTHON ?= python3
VENV := .venv
INSTALLED := $(VENV)/.installed

.PHONY: render test lint

render: $(INSTALLED)
	$(VENV)/bin/python scripts/render.py scenes/veach_bidir.xml -o renders/veach_bidir.exr

test: $(INSTALLED)
	$(VENV)/bin/python -m pytest

lint: $(INSTALLED)
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .

# Install again only when the requirements change; the package itself is installed editable.
$(INSTALLED): pyproject.toml
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@
