# make render: an image of a real scene.  make test: the tests.  Both set up .venv first.

PYTHON ?= python3
VENV := .venv
INSTALLED := $(VENV)/.installed

.PHONY: render test lint gallery references benchmark slow sweep

render: $(INSTALLED)
	$(VENV)/bin/python scripts/render.py scenes/veach_bidir.xml -o renders/veach_bidir.exr

test: $(INSTALLED)
	$(VENV)/bin/python -m pytest

slow: $(INSTALLED)
	$(VENV)/bin/python -m pytest -m slow

# The images of the README.
gallery: $(INSTALLED)
	$(VENV)/bin/python scripts/render.py scenes/lamp_behind_glass.xml -o renders/lamp_behind_glass.exr
	$(VENV)/bin/python scripts/render.py scenes/lamp_behind_glass.xml --integrator path -o renders/lamp_behind_glass_path.exr
	mkdir -p docs/images
	cp renders/lamp_behind_glass.png renders/lamp_behind_glass_path.png docs/images

# A small sweep of time against error, under ten minutes on two cores; goes on where it was stopped.
sweep: $(INSTALLED)
	-$(VENV)/bin/python scripts/reference.py cornell_box glass_caustics --resolution 64 --spp 128 --seconds 120
	$(VENV)/bin/python scripts/sweep.py presets/small.toml -o results/small
	$(VENV)/bin/python scripts/report.py results/small

# The references of the benchmark, a few hours on two cores; goes on where it was stopped.
references: $(INSTALLED)
	$(VENV)/bin/python scripts/reference.py --all --seconds 3600
	$(VENV)/bin/python scripts/reference.py glass_caustics --spp 256 --seconds 7200
	$(VENV)/bin/python scripts/reference.py cornell_box --max-depth 6 --spp 256 --seconds 3600

# The tables and plots of the README, about an hour, best on a quiet machine; goes on where it was stopped.
benchmark: $(INSTALLED)
	-$(VENV)/bin/python scripts/sweep.py presets/benchmark.toml -o results/benchmark
	cp results/benchmark/rows.parquet results/benchmark/probes.json docs/benchmark
	$(VENV)/bin/python scripts/report.py docs/benchmark --readme README.md

lint: $(INSTALLED)
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .

# Install again only when the requirements change; the package itself is installed editable.
$(INSTALLED): pyproject.toml
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@
