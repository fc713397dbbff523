# What takes minutes and is therefore not among the tests. Everything else: CONTRIBUTING.md.
PYTHON ?= .venv/bin/python

.PHONY: soak soak-short recovery
soak:  ## ten minutes of faults, then whole again
	$(PYTHON) -m benchmarks.soak --minutes 10

soak-short:  ## the same in one minute
	$(PYTHON) -m benchmarks.soak --minutes 1

recovery:  ## how long deaths take to be noticed and made good
	$(PYTHON) -m benchmarks.recovery
