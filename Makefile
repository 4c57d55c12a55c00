# Every target makes the environment it needs first (tools/bootstrap.sh), in .venv, build/ and install/ of this checkout.
SHELL := /bin/bash
RUN := . ./setup.bash &&
TESTS := -m pytest -n 2 --dist loadfile

.PHONY: help env demo paper figures sensorless servo grasp bench test lint coverage faults docs clean distclean

help:
	@echo "make demo       the paper's step responses over ROS 2 topics; results in out/demo"
	@echo "make test       lint and all tests"
	@echo "make paper      every experiment of the paper; results in out/paper"
	@echo "make figures    the same, and the pictures of the README in docs/"
	@echo "make sensorless what the models do without a sensor; results in out/sensorless"
	@echo "make servo      the step in real time, 10 kHz, against a finger in another process; results in out/servo"
	@echo "make grasp      a bead picked, held while it gets warm, placed, over topics; results in out/grasp"
	@echo "make bench      speed of the loop; results in out/bench.json"
	@echo "make lint       ruff and mypy"
	@echo "make faults     a thousand random schedules of faults on live nodes; stopped, it goes on; prints the seeds that fail"
	@echo "make coverage   the tests once more, and the lines that none of them reaches"
	@echo "make docs       these pages as a site, with links checked; in out/docs (CPython 3.11 or newer)"
	@echo "make env        only the environment; then '. ./setup.bash' to start single nodes"
	@echo "make clean      remove what was built; distclean: the environment and the results too"

env:
	@tools/bootstrap.sh

demo: env
	$(RUN) experiment step --out out/demo --overwrite

paper: env
	$(RUN) experiment all --out out/paper --overwrite

figures: paper
	$(RUN) python docs/figures.py out/paper

sensorless: env
	$(RUN) python -m piezo_sim.experiment.sensorless --out out/sensorless --overwrite

grasp: env
	$(RUN) python -m piezo_sim.experiment.on_nodes.grasp --out out/grasp --overwrite

servo: env
	$(RUN) python -m piezo_sim.experiment.on_nodes.servo --out out/servo --overwrite

bench: env
	$(RUN) python bench/run.py --out out/bench.json

test: lint
	$(RUN) python $(TESTS)

lint: env
	$(RUN) ruff check . && ruff format --check . && mypy

faults: env
	$(RUN) python test/faults.py

coverage: env
	$(RUN) coverage erase && coverage run $(TESTS) && coverage combine --quiet && coverage report

docs: env build/docs/installed
	$(RUN) PYTHONPATH=build/docs:$$PYTHONPATH python -m sphinx -W --keep-going --quiet docs out/docs

build/docs/installed: docs/requirements.txt
	rm -rf build/docs
	.venv/bin/python -m pip install --quiet --no-input --disable-pip-version-check --no-deps --target build/docs --requirement $<
	touch $@

clean:
	rm -rf build install log docs/generated piezo_control/servo/drivers/*.cpython-*.so

distclean: clean
	rm -rf .venv out
