# What takes minutes and is therefore not among the tests. Everything else: CONTRIBUTING.md.
PYTHON ?= .venv/bin/python

PAGE := build/page

.PHONY: docs docs-commands linkcheck page-check vendor soak soak-short recovery exchange freeze-oracle
docs:  ## the site, below build/docs; a warning, or a link that leads nowhere, is an error
	rm -rf docs/reference/api  # pages of modules that are gone
	$(PYTHON) -m sphinx -q -W --keep-going -n docs build/docs

docs-commands:  ## runs the commands of all pages in order, as printed; what is not run says so in its page
	$(PYTHON) -m pytest -q docs/test_commands_run.py

linkcheck:  ## follows the links to other sites; needs a network, so CI does not run it
	rm -rf docs/reference/api
	$(PYTHON) -m sphinx -q -b linkcheck docs build/linkcheck

page-check:  ## types and units of the page's own code; needs node and npm
	mkdir -p $(PAGE) && cp -r coordinator/show/web/static tests/page/. $(PAGE)
	cd $(PAGE) && npm install --silent --no-audit --no-fund --no-package-lock && npx --no-install tsc -p . && node --test

vendor:  ## fetches the libraries of the page anew, in the versions that coordinator/show/web/vendor.py names; needs npm
	$(PYTHON) -m coordinator.show.web.vendor

soak:  ## ten minutes of faults, then whole again
	$(PYTHON) -m benchmarks.soak --minutes 10

soak-short:  ## the same in one minute
	$(PYTHON) -m benchmarks.soak --minutes 1

recovery:  ## how long deaths take to be noticed and made good
	$(PYTHON) -m benchmarks.recovery

exchange:  ## messages and virtual times of scans: feeders, rows, loss, long hops
	$(PYTHON) -m benchmarks.exchange

freeze-oracle:  ## golden answers of the centralised estimator, from the present one: tests/golden/centralised/README.md
	OPENBLAS_NUM_THREADS=1 PYTHONPATH=. $(PYTHON) -m tests.golden.centralised.freeze
