/** What is said at a glance, and what is selected before anybody chooses. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { findTiles, findWorst } from "./static/glance.js";

const grid = {
  operating_limits: { lowest_vm_pu: 0.9, highest_vm_pu: 1.1, most_loading_percent: 100, most_residual: 3, most_unbalance_percent: 3 },
  buses: { id: [1, 2, 3, 4, 5, 6], area: ["a", "a", "a", "b", "b", "b"] }, branches: { id: ["1-2", "2-3"], area: ["a", "b"] },
};
const at = (where, value) => ({ at: where, value });
const spread = (total, lowest, highest, more = {}) => ({ known: total, total, outside: 0, worst: [], lowest, highest, ...more });
const total = (p, known = 1, of = known) => ({ known, total: of, p_kw: p, q_kvar: 0 });
const summary = {
  voltage: spread(6, at("5", 0.95), at("2", 1.01)), loading: spread(5, at("1-2", 3), at("2-3", 83.25)), current: spread(5, at("1-2", 1), at("2-3", 210)),
  residual: spread(2, at("m2", 1), at("m1", 2.5)), head: total(3926.5), loss: total(211.2, 5), load: total(3715.3, 6), generation: total(0, 6),
};
const area = (quality, removed = [], notes = []) => ({ quality, removed, notes, present: true, silent: false, estimated: true, fresh: true });
const moment = ({ of = {}, ...more } = {}) => ({
  causes: [], summary: { ...summary, ...of }, meter_counts: { used: 2 },
  meters: { meter: ["m1", "m9"], reading: [100, 55.5], estimate: [98.75, 20], unit: ["kw", "kw"] },
  links: [{ from: "a", to: "b", alive: true }, { from: "b", to: "a", alive: true }], view: { areas: { a: area("good"), b: area("good") } }, ...more,
});
const tilesOf = (more) => Object.fromEntries(findTiles(moment(more), grid).map((tile) => [tile.title, tile]));

test("a feeder on which nothing is wrong", () => {
  const tiles = tilesOf();
  assert.deepEqual(Object.values(tiles).map(({ state }) => state), ["good", "good", "good", "good", "good", "none"]);
  assert.equal(tiles.Voltage.text, "All 6 buses within 0.9 to 1.1 p.u.");
  assert.deepEqual(tiles.Voltage.offers.map(({ label }) => label), ["5: 0.9500", "2: 1.0100"]);
  assert.deepEqual(tiles.Loading.offers.map(({ label }) => label), ["2-3: 83.3 %", "2-3: 210.0 A"]);
  assert.deepEqual(tiles.Meters.offers, [{ label: "m1, reads 100.00 kW, estimated 98.75", choice: { kind: "meter", id: "m1" } }]);
  assert.equal(tiles.Areas.text, "All 2 are good.");
  assert.equal(tiles.Power.text, "head: 3926.5 kW\nload: 3715.3 kW\nlosses: 211.2 kW");
});

test("a phase is named, and its bus or branch is selected", () => {
  const { Voltage } = tilesOf({ of: { voltage: spread(6, at("5.b", 0.95), at("2.c", 1.01)) } });
  assert.deepEqual(Voltage.offers.map(({ label, choice }) => [label, choice.id]), [["5.b: 0.9500", "5"], ["2.c: 1.0100", "2"]]);
  assert.deepEqual(findWorst(moment({ of: { voltage: spread(6, at("5.b", 0.95), at("2.c", 1.01)) } })), { kind: "bus", id: "5" });
  const loading = spread(5, at("1-2.a", 3), at("2-3.b", 112), { outside: 1, worst: [at("2-3.b", 112)] }), current = spread(5, at("1-2.a", 1), at("2-3.b", 210));
  const { Loading } = tilesOf({ of: { loading, current }, view: { areas: { a: area("good"), b: area("degraded") } } });
  assert.deepEqual(Loading.offers.map(({ label, choice }) => [label, choice.id]), [["2-3.b: 112.0 % (degraded)", "2-3"], ["2-3.b: 210.0 A (degraded)", "2-3"]]);
  assert.deepEqual(findWorst(moment({ of: { loading } })), { kind: "branch", id: "2-3" });
});

test("what is outside the limits is counted and offered, the farthest first", () => {
  const { Voltage, Loading } = tilesOf({
    of: {
      voltage: spread(6, at("3", 0.7), at("2", 1.2), { outside: 5, worst: ["3", "2", "5", "1"].map((bus) => at(bus, 0.7)) }),
      loading: spread(5, at("1-2", 3), at("2-3", 112), { outside: 1, worst: [at("2-3", 112)] }),
    },
  });
  assert.deepEqual([Voltage.state, Voltage.text], ["bad", "5 buses outside 0.9 to 1.1 p.u."]);
  assert.deepEqual(Voltage.offers.map(({ choice }) => choice.id), ["3", "2", "5", "1"]);
  assert.deepEqual([Loading.state, Loading.text, Loading.offers[0].label], ["bad", "1 branch above 100 %.", "2-3: 112.0 %"]);
});

test("buses above the limit of unbalance are counted and offered", () => {
  const { Voltage } = tilesOf({ of: { unbalance: spread(4, at("2", 0.1), at("5", 3.4), { outside: 1, worst: [at("5", 3.4)] }) } });
  assert.deepEqual([Voltage.state, Voltage.text], ["bad", "All 6 buses within 0.9 to 1.1 p.u.; unbalance of 1 bus above 3 %"]);
  assert.deepEqual(Voltage.offers, [{ label: "5: unbalance 3.4 %", choice: { kind: "bus", id: "5" } }]);
});

test("what is not known now is not called good, and is counted", () => {
  const { Voltage, Power } = tilesOf({ of: { voltage: spread(6, at("5", 0.95), at("2", 1.01), { known: 4 }), head: total(null, 0, 1), load: total(12, 4, 6) } });
  assert.deepEqual([Voltage.state, Voltage.text], ["degraded", "Of 6 buses 4 known, within 0.9 to 1.1 p.u."]);
  assert.equal(Power.text, "load: 12.0 kW (4 of 6 buses)\nlosses: 211.2 kW");
  assert.equal(tilesOf({ of: { voltage: spread(6, null, null, { known: 0 }) } }).Voltage.text, "Of 6 buses 0 known.");
  const nothing = spread(6, null, null, { known: 0 }), dark = tilesOf({ of: { voltage: nothing, loading: nothing, residual: nothing, head: total(null, 0, 1), load: total(null, 0, 1), loss: total(null, 0, 1) } });
  assert.deepEqual(["Voltage", "Loading", "Meters", "Power"].map((title) => dark[title].state), ["unknown", "unknown", "unknown", "unknown"]);
  assert.equal(tilesOf({ of: { loading: spread(0, null, null) } }).Loading.text, "No branch has a rating; the largest current:");
});

test("a number of an area that is not good says so", () => {
  const { Voltage, Loading } = tilesOf({ view: { areas: { a: area("good"), b: area("degraded") } } });
  assert.deepEqual(Voltage.offers.map(({ label }) => label), ["5: 0.9500 (degraded)", "2: 1.0100"]);
  assert.equal(Loading.offers[0].label, "2-3: 83.3 % (degraded)");
  assert.deepEqual([Voltage.state, Voltage.text, Loading.state], ["degraded", "All 6 buses within 0.9 to 1.1 p.u.; 3 not of good areas", "degraded"]);
});

test("removed meters are named with reading and estimate", () => {
  const { Meters } = tilesOf({ meter_counts: { used: 2, removed: 1, silent: 3 }, view: { areas: { a: area("good", ["m9"]) } } });
  assert.deepEqual([Meters.state, Meters.text], ["degraded", "1 removed, 3 silent. Largest normalised residual 2.50 of 3."]);
  assert.deepEqual(Meters.offers.map(({ label }) => label), ["m9 is removed, reads 55.50 kW, estimated 20.00", "m1, reads 100.00 kW, estimated 98.75"]);
});

test("a residual above its limit is no fault while all readings together agree", () => {
  const residual = spread(2, at("m2", 1), at("m1", 3.57), { outside: 1, worst: [at("m1", 3.57)] }), degraded = { a: area("degraded"), b: area("good") };
  const [sound, poor] = [tilesOf({ of: { residual } }), tilesOf({ of: { residual }, view: { areas: degraded } })].map((tiles) => tiles.Meters);
  assert.deepEqual([sound.state, sound.text], ["good", "Largest normalised residual 3.57 of 3, by chance."]);
  assert.deepEqual([poor.state, poor.text], ["degraded", "Largest normalised residual 3.57 of 3."]);
});

test("links are amber where some work, and red where none does", () => {
  const stateOf = (...alive) => tilesOf({ links: alive.map((is, k) => ({ from: "ab"[k], to: "ba"[k], alive: is })) }).Links.state;
  assert.deepEqual([stateOf(true, true), stateOf(true, false), stateOf(false, false)], ["good", "degraded", "bad"]);
});

test("areas that are not good are effects unless a cause names them, and those left out are counted", () => {
  const causes = [{ kind: "gone", areas: ["a"], buses: [], branches: [], meters: [] }], areas = Object.fromEntries([..."abcde"].map((name) => [name, area(name === "a" ? "stale" : "degraded", [], ["behind a"])]));
  const { Areas } = tilesOf({ causes, view: { areas } });
  assert.equal(Areas.text, "5 of 5 not good; the worst 3, and 2 more.");
  assert.deepEqual(Areas.offers.map(({ label }) => label), ["a: stale, cause", "b: degraded, effect", "c: degraded, effect"]);
});

test("a dead link is named, and areas that are not good with their reason, the worst first", () => {
  const links = [{ from: "a", to: "b", alive: true }, { from: "b", to: "a", alive: false }];
  const { Links, Areas } = tilesOf({ links, view: { areas: { a: area("degraded", [], ["neighbour c is gone"]), b: area("good"), c: area("stale", [], ["is gone"]) } } });
  assert.deepEqual([Links.state, Links.text], ["degraded", "1 of 2 directions work: nothing from b to a."]);
  assert.deepEqual([Areas.state, Areas.text], ["bad", "2 of 3 not good."]);
  assert.deepEqual(Areas.offers.map(({ label }) => label), ["c: stale, is gone", "a: degraded, neighbour c is gone"]);
});

test("the worst is the place of the first cause, else what is beyond its limit, else the lowest voltage", () => {
  const cause = (more) => ({ areas: [], buses: [], branches: [], meters: [], ...more });
  assert.deepEqual(findWorst(moment({ causes: [cause({ areas: ["c"], buses: [6] }), cause({ meters: ["m"] })] })), { kind: "bus", id: "6" });
  assert.deepEqual(findWorst(moment({ of: { loading: spread(5, null, null, { outside: 1, worst: [at("2-3", 112)] }) } })), { kind: "branch", id: "2-3" });
  assert.deepEqual(findWorst(moment()), { kind: "bus", id: "5" });
  assert.equal(findWorst(moment({ of: { voltage: spread(6, null, null) } })), null);
});
