/** Nodes and conductors of buses and branches. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { freshBranches, joinNodes, largestLoadings, lookOf, nodesOf, worstVoltages } from "./static/phases.js";
import { describeTogether, pickPhases, tabulatePhases } from "./static/selected.js";

const limits = { lowest_vm_pu: 0.9, highest_vm_pu: 1.1 };
const grid = {
  operating_limits: limits,
  buses: { id: [1, 2, 3], phase: ["abc", "bc", "s1s2"] },
  branches: { id: ["1-2", "bank", "open"], from_bus: [1, 1, 2], to_bus: [2, 3, 3], in_service: [true, true, false] },
  nodes: { bus: [1, 1, 1, 2, 2, 3, 3], phase: ["a", "b", "c", "b", "c", "s1", "s2"] },
  conductors: { branch: ["1-2", "1-2", "bank", "bank", "bank", "open"], phase: ["b", "c", "a", "s1", "s2", "b"] },
};
const balanced = { operating_limits: limits, buses: { id: [1, 2] }, branches: { id: ["1-2"], from_bus: [1], to_bus: [2], in_service: [true] } };

test("without phases a bus is a node and a branch a conductor, whatever its numbers", () => {
  assert.deepEqual(nodesOf(balanced), { bus: [1, 2], phase: ["abc", "abc"] });
  assert.deepEqual(joinNodes(balanced), [[0, 1]]);
  assert.deepEqual(worstVoltages(balanced, { buses: { vm_pu: [1.2, 0.5], fresh: [true, false] } }), [{ value: 1.2, phase: "abc" }, { value: null, phase: "abc" }]);
  const shown = worstVoltages(balanced, { buses: { id: [2, 1, 2], vm_pu: [0.95, 1, 0.94], fresh: [true, true, true] }, worst_nodes: [1, 2] });
  assert.deepEqual(shown.map(({ value }) => value), [1, 0.94]);
});

test("a bus has the colour of the phase that the server has chosen", () => {
  const buses = { vm_pu: [0.97, 1.06, 1, 0.99, null, 0.8, 1.15], fresh: [true, true, true, true, true, false, true] };
  assert.deepEqual(worstVoltages(grid, { buses, worst_nodes: [0, 3] }), [{ value: 0.97, phase: "a" }, { value: 0.99, phase: "b" }, { value: null, phase: "abc" }]);
});

test("a branch is as loaded as its phase that is loaded most", () => {
  const branches = { loading_percent: [20, 80, null, null, null, 5], fresh: [true, true, true, true, true, false] };
  assert.deepEqual(largestLoadings(grid, branches), [{ value: 80, phase: "c" }, { value: null, phase: "abc" }, { value: null, phase: "abc" }]);
  assert.deepEqual(freshBranches(grid, branches), [true, true, false]);
});

test("lines join nodes of one phase, and those behind windings; nothing where a phase ends or a branch is open", () => {
  assert.deepEqual(joinNodes(grid), [[1, 3], [2, 4], [0, 5], [0, 6]]);
});

test("each phase differs from the others in colour and in shape", () => {
  const looks = ["a", "b", "c", "s1", "s2"].map(lookOf);
  for (const part of ["ink", "shape", "sign"]) assert.equal(new Set(looks.map((look) => look[part])).size, looks.length, part);
  assert.equal(lookOf("constructor"), lookOf("abc"));
});

const about = { quality: ["good", "good"], fresh: [true, true], value_age_s: [1, 1] };

test("what is selected has a column for each phase, and sums of powers", () => {
  const rows = { ...about, phase: ["a", "c"], vm_pu: [0.98, 1.01], p_kw: [-10, -20.5], q_kvar: [null, 3], unbalance_percent: [null, null], grounded: [true, true] };
  assert.deepEqual(tabulatePhases(rows), {
    phases: ["a", "c"],
    rows: [["voltage (p.u.)", "0.9800", "1.0100", ""], ["injected active power (kW)", "-10.0", "-20.5", "-30.5"], ["injected reactive power (kvar)", "-", "3.0", "-"]],
  });
  const facts = Object.fromEntries(describeTogether(rows));
  assert.equal(facts.phases, "a, c");
  assert.ok(!("unbalance (%)" in facts));
});

test("of the rows of two areas at a boundary one of each phase is shown, the fresh one", () => {
  const rows = { phase: ["a", "c", "a", "b", "c"], area: ["x", "x", "y", "y", "y"], fresh: [false, true, true, true, true], vm_pu: [1, 2, 3, 4, 5] };
  assert.deepEqual(pickPhases(rows), { phase: ["a", "b", "c"], area: ["y", "y", "x"], fresh: [true, true, true], vm_pu: [3, 4, 2] });
});

test("of a branch the most loaded phase and the neutral current are said, and the loss of all phases alone", () => {
  const rows = { ...about, phase: ["a", "b"], i_from_a: [10, 12], i_to_a: [90, 100], loss_kw: [3, -1], neutral_a: [5, 5], loading_percent: [null, null] };
  const facts = Object.fromEntries(describeTogether(rows));
  assert.deepEqual([facts["most loaded phase"], facts["neutral current (A)"], facts["loss (kW), all phases"]], ["b, 100.0 A", "5.0", "2.00"]);
  assert.deepEqual(tabulatePhases(rows).rows.map(([title]) => title), ["current (A)", "current at the to end (A)"]);
  assert.equal(Object.fromEntries(describeTogether({ ...rows, loading_percent: [70, 60] }))["most loaded phase"], "a, 70.0 %");
});

test("without a path to ground only voltages between phases are said", () => {
  const rows = { ...about, phase: ["a", "b", "c"], grounded: [false, false, false], vm_pu: [1, 1, 1], vm_kv: [2, 2, 2], va_deg: [0, -120, 120], p_kw: [1, 2, 3] };
  assert.deepEqual(tabulatePhases(rows).rows, [["injected active power (kW)", "-", "-", "-", "6.0"]]);
  const facts = Object.fromEntries(describeTogether(rows));
  assert.deepEqual(["a to b", "b to c", "c to a"].map((pair) => facts[`voltage ${pair} (kV)`]), ["3.4641", "3.4641", "3.4641"]);
});
