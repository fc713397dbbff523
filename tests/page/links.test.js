/** What is said of dead links. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { countReceived, findDeadLinks } from "./static/links.js";

const there = { present: true, silent: false, estimated: true };
const link = (from, to, alive) => ({ from, to, alive, age_s: alive ? 0.1 : null });
const moment = (links, areas = { a: there, b: there, c: there }) => ({ links, view: { areas } });

test("who receives nothing, and from whom", () => {
  const links = [link("b", "a", true), link("c", "a", false), link("a", "b", true)];
  assert.deepEqual([...countReceived(links)], [["a", "1 of 2: nothing from c"], ["b", "1 of 1"]]);
  assert.deepEqual(findDeadLinks(moment(links)), [{ receiver: "a", sender: "c", text: "nothing from c to a" }]);
});

test("a link that is dead both ways is one", () => {
  const dead = findDeadLinks(moment([link("b", "a", false), link("a", "b", false), link("c", "a", true)]));
  assert.deepEqual(dead.map(({ text }) => text), ["nothing between a and b"]);
});

test("of an area that is gone or silent no link is called dead", () => {
  const links = [link("b", "a", false), link("a", "b", false)];
  for (const gone of [undefined, { present: false, silent: false }, { present: true, silent: true }]) {
    assert.deepEqual(findDeadLinks(moment(links, { a: there, b: gone })), []);
  }
});

test("a link that has not begun is not called dead", () => {
  const links = [link("b", "a", false), link("a", "b", false)], begins = { ...there, estimated: false };
  assert.deepEqual(findDeadLinks(moment(links, { a: begins, b: begins })), []);
  assert.deepEqual(findDeadLinks(moment(links, { a: there, b: begins })).map(({ text }) => text), ["nothing from b to a"]);
});
