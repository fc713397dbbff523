/** Tables as CSV. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { csvOf, csvOfColumns } from "./static/csv.js";

test("numbers keep all their digits, unknown ones are empty, and texts are quoted where they must be", () => {
  assert.equal(csvOf(["a", "b"], [[0.1 + 0.2, null], ['x, "y"', -3]]), 'a,b\n0.30000000000000004,\n"x, ""y""",-3\n');
  assert.equal(csvOfColumns({ id: ["1", "2"], vm: [1, null] }), "id,vm\n1,1\n2,\n");
});

test("a name that a stranger chooses is no formula of a spreadsheet", () => {
  assert.equal(csvOf(["name"], [["=HYPERLINK(1)"], ["+1"], ["@x"]]), "name\n'=HYPERLINK(1)\n'+1\n'@x\n");
});
