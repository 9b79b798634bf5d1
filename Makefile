# make quickstart   demonstrations, training and evaluation of a Meta-World task, about 2 minutes on two cores (with bfloat16)
# make ur5e-demo    a simulated UR5e recorded, trained, rolled out and replayed
# make test         the tests
# make check        style, types, formatting, dependencies, known vulnerabilities of their pinned versions
# make compat       the tests' core against the lowest and the highest versions of pyproject.toml

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: quickstart ur5e-demo test check compat format

quickstart: $(INSTALLED)
	$(BIN)/python examples/quickstart.py

ur5e-demo: $(INSTALLED)
	$(BIN)/python examples/ur5e_demo.py

test: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses=logical --maxprocesses=4 --dist=loadfile

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pip check
	$(BIN)/python tests/audit.py

compat: $(INSTALLED)
	$(BIN)/python tests/compat.py

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(INSTALLED): pyproject.toml constraints.txt
	python=$$(.ci/python) && "$$python" -m venv $(VENV)
	@echo "Installing into $(VENV): several minutes and 6 GB, most of them PyTorch's"
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@
