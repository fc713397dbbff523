/** What is said at a glance. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { findTiles } from "./static/glance.js";

const grid = { limits: [0.9, 1.1], buses: { id: [1, 2, 3, 4, 5, 6] } };
const area = (quality, removed = []) => ({ quality, removed, present: true, silent: false, estimated: true });
const moment = (more = {}) => ({
  buses: { vm_pu: [1, 1.01, 0.99, 1, 0.95, 1] }, meters: { meter: ["m1", "m2"], normalised_residual: [2.5, 1] }, meter_counts: { used: 2 },
  links: [{ from: "a", to: "b", alive: true }, { from: "b", to: "a", alive: true }], view: { areas: { a: area("good"), b: area("good") } }, ...more,
});
const tilesOf = (more) => findTiles(moment(more), grid);

test("a feeder on which nothing is wrong", () => {
  const tiles = tilesOf();
  assert.deepEqual(tiles.map(({ state }) => state), ["good", "good", "good", "good"]);
  assert.deepEqual(tiles[0].offers.map(({ label }) => label), ["5: 0.95", "2: 1.01"]);
  assert.deepEqual(tiles[1].offers, [{ label: "m1", choice: { kind: "meter", id: "m1" } }]);
  assert.equal(tiles[3].text, "All 2 are good.");
});

test("buses outside the limits are offered, the farthest first, and counted", () => {
  const [voltages] = tilesOf({ buses: { vm_pu: [0.88, 1.2, 0.7, 1.11, 0.85, 1] } });
  assert.equal(voltages.state, "bad");
  assert.equal(voltages.text, "5 buses outside 0.9 to 1.1 p.u., the worst 4 of them:");
  assert.deepEqual(voltages.offers.map(({ choice }) => choice.id), ["3", "2", "5", "1"]);
});

test("a voltage that is not known is not called good, nor is one of which two areas speak counted twice", () => {
  const [some] = tilesOf({ buses: { vm_pu: [1, null, null, 1, 1, 1] } });
  assert.deepEqual([some.state, some.text], ["degraded", "Within 0.9 to 1.1 p.u.; of 2 buses it is not known; lowest and highest:"]);
  assert.equal(tilesOf({ buses: {} })[0].text, "No voltage is known.");
  const [twice] = tilesOf({ buses: { id: [1, 2, 2], vm_pu: [1, 1.2, 1.2] } });
  assert.equal(twice.text, "1 bus outside 0.9 to 1.1 p.u.:");
});

test("removed meters are named beside the worst of those that are used", () => {
  const [, meters] = tilesOf({ meter_counts: { used: 2, removed: 1, silent: 3 }, view: { areas: { a: area("good", ["m9"]) } } });
  assert.deepEqual([meters.state, meters.text], ["bad", "Normalised residual 2.5; 1 removed, 3 silent:"]);
  assert.deepEqual(meters.offers.map(({ label }) => label), ["m1", "m9 is removed"]);
});

test("a dead link is named, and areas that are not good, the worst first", () => {
  const links = [{ from: "a", to: "b", alive: true }, { from: "b", to: "a", alive: false }];
  const [, , said, areas] = tilesOf({ links, view: { areas: { a: area("degraded"), b: area("good"), c: area("stale") } } });
  assert.deepEqual([said.state, said.text], ["bad", "1 of 2 directions work: nothing from b to a."]);
  assert.deepEqual([areas.state, areas.text], ["bad", "2 of 3 not good:"]);
  assert.deepEqual(areas.offers.map(({ label }) => label), ["c: stale", "a: degraded"]);
});
