# make render: an image of a real scene.  make test: the tests.  Both set up .venv first.

PYTHON ?= python3
VENV := .venv
INSTALLED := $(VENV)/.installed

# Every scene of the benchmark.
SCENES := $(basename $(notdir $(wildcard scenes/*.xml)))

.PHONY: render test costly slow one-core costs lint gallery pictures notebook docs package references benchmark sweep stress same \
	planted-bugs scale

render: $(INSTALLED)
	$(VENV)/bin/mitsuba-bdpt render scenes/veach_bidir.xml -o renders/veach_bidir.exr

# Two processes, since much of a test is compiling kernels, on one core.
PYTEST := $(VENV)/bin/python -m pytest -n 2 --dist worksteal

# The cheap tests, and all that see planted bugs (tests/support/costs.py).
test: $(INSTALLED)
	$(PYTEST)

# The commands and their images on one core, where what waits for a second thread hangs: a minute.
one-core: $(INSTALLED)
	timeout 600 taskset -c 0 $(VENV)/bin/python -m pytest tests/image tests/cli

# The tests that take seconds.
costly: $(INSTALLED)
	$(PYTEST) -m costly

# All tests that make test leaves out.
slow: $(INSTALLED)
	$(PYTEST) -m "slow or costly" -o faulthandler_timeout=14400

# What tests cost, in tests/support/costs.json, by which make test leaves them out.
costs: $(INSTALLED)
	echo '{}' > tests/support/costs.json
	$(PYTEST) -m "not slow and not stress" --costs

# The images of the README and of docs/reports/figures.md.
gallery: $(INSTALLED)
	$(VENV)/bin/mitsuba-bdpt render scenes/lamp_behind_glass.xml -o renders/lamp_behind_glass.exr
	$(VENV)/bin/mitsuba-bdpt render scenes/lamp_behind_glass.xml --integrator path -o renders/lamp_behind_glass_path.exr
	mkdir -p docs/images/gallery
	cp renders/lamp_behind_glass.png renders/lamp_behind_glass_path.png docs/images
	for scene in $(SCENES); do \
		$(VENV)/bin/mitsuba-bdpt render scenes/$$scene.xml -o renders/gallery/$$scene.exr \
			--spp 256 -D resolution=192 && cp renders/gallery/$$scene.png docs/images/gallery || exit 1; \
	done

# The caustic below the glass ball, and what is seen in it.
CAUSTICS := 0.28,0.86 0.3,0.7

# The pictures of docs/reports/pictures.md.
pictures: $(INSTALLED)
	mkdir -p docs/images
	$(VENV)/bin/mitsuba-bdpt equal-time veach_bidir --spp 25 -o docs/images/veach_bidir_equal_time.png
	$(VENV)/bin/mitsuba-bdpt equal-time glass_caustics --spp 64 -o docs/images/glass_caustics_equal_time.png \
		--windows $(CAUSTICS)
	$(VENV)/bin/python scripts/polarization.py
	for scene in glass_caustics rough_glass_caustics frosted_glass_caustics; do \
		$(VENV)/bin/mitsuba-bdpt equal-time $$scene --spp 64 -o docs/images/$${scene}_merging.png \
			-i bdpt path "bdpt merging=true" --windows $(CAUSTICS) || exit 1; \
	done
	for scene in pool_floor lamp_in_glass_seen pane frosted_bulb polished_metal; do \
		$(VENV)/bin/mitsuba-bdpt equal-time $$scene --spp 64 -o docs/images/$${scene}_merging.png \
			-i bdpt path "bdpt merging=true" || exit 1; \
	done
	$(VENV)/bin/mitsuba-bdpt equal-time lamp_behind_glass --spp 64 -o docs/images/lamp_behind_glass_equal_time.png
	$(VENV)/bin/mitsuba-bdpt equal-time fog_caustic --spp 64 -o docs/images/fog_caustic_equal_time.png
	$(VENV)/bin/mitsuba-bdpt equal-time pool_water --spp 64 -o docs/images/pool_water_equal_time.png
	$(VENV)/bin/mitsuba-bdpt pyramid veach_bidir -o renders/pyramid.exr
	cp renders/pyramid_weighted.png renders/pyramid_unweighted.png docs/images

# The tutorial of docs/user/tutorial.py as a notebook that was run, some minutes.
notebook: $(INSTALLED)
	$(VENV)/bin/jupytext --quiet --to ipynb --set-kernel python3 docs/user/tutorial.py
	$(VENV)/bin/jupyter execute --inplace docs/user/tutorial.ipynb

# The documentation as a site, in build/site.
docs: $(INSTALLED)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --group docs
	$(VENV)/bin/python -m sphinx --quiet --fail-on-warning --fresh-env -c docs . build/site

# Wheel and sdist, checked, and the wheel tried in an environment of its own.
package: $(INSTALLED)
	rm -rf dist build/try
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check build twine
	$(VENV)/bin/python -m build
	$(VENV)/bin/python -m twine check --strict dist/*
	$(PYTHON) -m venv build/try
	build/try/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	cd build/try && bin/mitsuba-bdpt doctor

# A small sweep of time against error, under ten minutes on two cores; goes on where it was stopped.
sweep: $(INSTALLED)
	$(VENV)/bin/mitsuba-bdpt sweep presets/small.toml -o results/small
	$(VENV)/bin/mitsuba-bdpt report results/small
	$(VENV)/bin/mitsuba-bdpt page results/small

# Attempts to break the renderer, twenty minutes on two cores, and their record: docs/reports/stress.json.
stress: $(INSTALLED)
	$(PYTEST) -m stress --record tests/stress_cases

# Whether a change keeps the images of all scenes, beside another checkout. make same BEFORE=../before
same: $(INSTALLED)
	$(VENV)/bin/python scripts/versus.py $(BEFORE) --same --pairs 1 --spp 16

# Planted bugs, and whether the tests see them: half an hour.
planted-bugs: $(INSTALLED)
	$(VENV)/bin/python scripts/planted_bugs.py

# The references of the benchmark, a few hours on two cores; goes on where it was stopped.
references: $(INSTALLED)
	$(VENV)/bin/mitsuba-bdpt reference --all --seconds 3600
	$(VENV)/bin/mitsuba-bdpt reference glass_caustics --spp 256 --seconds 7200
	$(VENV)/bin/mitsuba-bdpt reference cornell_box --spp 256 --seconds 3600

# The data and plots of docs/reports/benchmark, about an hour, best on a quiet machine; goes on where it was stopped.
benchmark: $(INSTALLED)
	-$(VENV)/bin/mitsuba-bdpt sweep presets/benchmark.toml -o results/benchmark
	$(VENV)/bin/python scripts/floor.py -o results/benchmark/floor.json
	$(VENV)/bin/mitsuba-bdpt report results/benchmark
	cp $(addprefix results/benchmark/,rows.parquet floor.json *.png) docs/reports/benchmark
	$(VENV)/bin/mitsuba-bdpt figure docs/reports/benchmark --plot efficiency --integrators "path multijitter" volpathmis \
		-o docs/images/efficiency.png

# What is fixed per render, per object and per pass, over `path`: docs/reports/scale.json.
scale: $(INSTALLED)
	$(VENV)/bin/python scripts/scale.py

# Style, format, the order of the layers, types.
lint: $(INSTALLED)
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .
	$(VENV)/bin/lint-imports --no-cache
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

# Install again only when the requirements change; the package itself is installed editable. Dependency groups need
# pip 25.1, and the one that comes with Python 3.11 is older.
$(INSTALLED): pyproject.toml
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --upgrade 'pip>=25.1'
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check \
		--editable '.[cluster,denoise,measure]' --group dev
	touch $@
