/** How numbers and times are shown. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { clock, entryOf, fixed, labelOf, number, qualityClass, unitOf, when } from "./static/format.js";

test("what is no number is a dash, and no number has more digits than asked for", () => {
  assert.deepEqual([null, undefined, NaN, Infinity].map((value) => number(value)), ["-", "-", "-", "-"]);
  assert.deepEqual([1, 0.123456789, -12345.678].map((value) => number(value, 4)), ["1", "0.1235", "-12350"]);
  assert.equal(number(1.5e12), "1.50e+12");
});

test("numbers of a column have the same digits, however many they need", () => {
  assert.deepEqual([1, 0.95, 0.97004].map((vm) => fixed(vm, "vm_pu")), ["1.0000", "0.9500", "0.9700"]);
  assert.deepEqual([fixed(-0.004, "kw"), fixed(12.3456, "kw"), fixed(0.123456789, "")], ["0.00", "12.35", "0.12346"]);
  assert.deepEqual([null, undefined, NaN, "3", Infinity].map((value) => fixed(value, "vm_pu")), ["-", "-", "-", "-", "-"]);
});

test("columns and units have the names that people use, and unknown ones stay readable", () => {
  assert.deepEqual(["vm_pu", "p_from_kw", "new_column"].map(labelOf), ["voltage (p.u.)", "active power (kW)", "new column"]);
  assert.deepEqual(["kw", "pu", "furlong", undefined].map(unitOf), ["kW", "p.u.", "furlong", "p.u., rad"]);
});

test("a word of a stranger never looks good", () => {
  assert.deepEqual(["good", "degraded", "stale", "<b>", ""].map(qualityClass), ["good", "degraded", "bad", "bad", "bad"]);
});

test("simulated time is seconds, recorded and live time the time of day", () => {
  const start = 1_700_000_000;
  assert.equal(when({ mode: "playback", time: 2.5, at: 2.5 }, 1.25), "1.25 s");
  assert.equal(when({ mode: "playback", time: start + 2, at: 2 }, 1), clock(start + 1));
  assert.equal(when({ mode: "live", time: start, at: start }, start - 7), clock(start - 7));
});

test("a name that a stranger chooses finds nothing that every object has", () => {
  assert.equal(entryOf({ a: 1 }, "a"), 1);
  for (const name of ["constructor", "__proto__", "toString"]) assert.equal(entryOf({ a: 1 }, name), undefined);
  assert.equal(entryOf(JSON.parse('{"__proto__": 2}'), "__proto__"), 2);
});
