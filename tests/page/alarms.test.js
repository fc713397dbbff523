/** Alarms, the sentence above all else, and events that lasted. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { updateAlarms } from "./static/alarms.js";
import { findSaid } from "./static/cause.js";
import { findLasting } from "./static/events.js";

const cause = (what, more = {}) => ({ kind: "gone", severity: "alarm", scope: "data", remark: "The data.", what, since: 3, action: "restart its agent", areas: ["a"], buses: [], branches: [], meters: [], effects: [], ...more });

test("an alarm that is over stays until somebody has acknowledged it, and one that comes back is new", () => {
  const first = updateAlarms([], [cause("a is gone")], 5, 1);
  assert.deepEqual(first.map(({ what, since, over, acknowledged }) => [what, since, over, acknowledged]), [["a is gone", 3, null, false]]);
  const over = updateAlarms(first, [], 9, 1);
  assert.deepEqual(over.map((alarm) => alarm.over), [9]);
  assert.deepEqual(updateAlarms(over, [], 12, 1), over);
  assert.deepEqual(updateAlarms(over, [cause("a is gone", { since: 13 })], 14, 1).map(({ since, over: ended }) => [since, ended]), [[13, null], [3, 9]]);
  assert.deepEqual(updateAlarms(first.map((alarm) => ({ ...alarm, acknowledged: true })), [], 9, 1), []);
});

test("an alarm that is over at once is none", () => {
  const brief = updateAlarms([], [cause("a is gone", { since: 5 })], 5, 2);
  assert.deepEqual([updateAlarms(brief, [], 6, 2).length, updateAlarms(brief, [], 7, 2).length], [0, 1]);
});

test("an alarm whose figures change stays the one that was acknowledged", () => {
  const seen = updateAlarms([], [cause("1 line at 112 %", { since: null, branches: ["1-2"] })], 5, 1).map((alarm) => ({ ...alarm, acknowledged: true }));
  const [later, ...others] = updateAlarms(seen, [cause("1 line at 115 %", { since: null, branches: ["1-2"] })], 9, 1);
  assert.deepEqual([later.what, later.since, later.acknowledged, others.length], ["1 line at 115 %", 5, true, 0]);
  const [spread] = updateAlarms([later], [cause("2 lines at 115 %", { since: null, branches: ["1-2", "7-8"] })], 10, 1);
  assert.deepEqual([spread.acknowledged, spread.since], [false, 5]);
});

const moment = (causes, qualities) => ({
  causes, mode: "playback", at: 8, time: 8, summary: { voltage: { known: 20, total: 33 } }, view: { areas: Object.fromEntries(qualities.map((quality, k) => [k, { quality }])) },
});

test("the root cause is said first, with its effects in one line, and further causes in a line each", () => {
  const effects = ["b, c are degraded", "d is none"], meter = cause("meter m is off", { since: null, action: "" });
  const said = findSaid(moment([cause("a is gone", { effects }), meter, meter, meter], ["stale"]));
  assert.deepEqual([said.state, said.what, said.action], ["bad", "✕ a is gone since 3 s", "→ restart its agent"]);
  assert.equal(said.remark, "The data. Effects: b, c are degraded, d is none.");
  assert.deepEqual(said.further, ["Also: meter m is off", "Also: meter m is off; and 1 more"]);
});

test("a warning is amber, and a limit is exceeded at least since it was seen", () => {
  const said = findSaid(moment([cause("a line is at 112 %", { severity: "warning", scope: "grid" })], ["good"]));
  assert.deepEqual([said.state, said.what], ["degraded", "! a line is at 112 %, seen since 3 s"]);
});

test("without a cause a feeder is sound only if all its areas are good", () => {
  assert.deepEqual(findSaid(moment([], ["good", "good"])), { state: "good", what: "✓ Nothing is wrong", action: "", remark: "2 of 2 areas good, 20 of 33 buses known.", further: [] });
  assert.deepEqual([moment([], ["good", "none"]), moment([], [])].map((one) => findSaid(one).state), ["degraded", "degraded"]);
});

const event = (time, kind, text, area = "a") => ({ time, area, kind, text });

test("events leave out what lasted less than a scan, and what then says what held before", () => {
  const events = [
    event(0, "quality", "good"), event(10, "quality", "degraded: late"), event(10.4, "quality", "good"), event(11, "link", "receives nothing from b"),
    event(20, "quality", "stale: is gone"), event(30, "quality", "good"), event(31, "link", "receives from b again"),
  ];
  assert.deepEqual(findLasting(events, 1).map(({ time }) => time), [0, 11, 20, 30, 31]);
  assert.deepEqual(findLasting(events, 0).map(({ time }) => time), [0, 10, 10.4, 11, 20, 30, 31]);
});

test("what holds now is an event, however short, and areas are not mixed", () => {
  const events = [event(0, "quality", "good"), event(0, "quality", "good", "b"), event(65, "vanished", "is gone"), event(65, "quality", "stale"), event(65.2, "quality", "degraded", "b")];
  assert.deepEqual(findLasting(events, 60), events);
});
