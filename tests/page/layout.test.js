/** Where things lie on the canvas, and what axes span. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { findShapes, fitInto, keepApart, middle, nearest, shareOf, spanOf, usualLength } from "./static/layout.js";

test("a feeder fills the canvas but for its margin, and one bus alone is no division by zero", () => {
  const { kx, ox, ky, oy } = fitInto([2, 6], [0, 10], 440, 240, 20);
  assert.deepEqual([2, 6].map((x) => kx * x + ox), [20, 420]);
  assert.deepEqual([0, 10].map((y) => ky * y + oy), [20, 220]);
  const alone = fitInto([3], [4], 440, 240, 20);
  assert.ok(Number.isFinite(alone.kx * 3 + alone.ox));
  assert.ok(Number.isFinite(fitInto([], [], 0, 0, 20).kx));
});

const grid = {
  buses: { id: [1, 2, 3] },
  branches: { id: ["1-2", "2-3", "9-9"], from_bus: [1, 2, 9], to_bus: [2, 3, 9], area: ["a", "b", "b"] },
  areas: [{ name: "a", buses: [1, 2] }, { name: "b", buses: [2, 3, 77] }],
};

test("an area is its buses and branches; what is not on the drawing is left out", () => {
  assert.deepEqual(findShapes(grid), [
    { name: "a", rows: [0, 1], segments: [[0, 1]] },
    { name: "b", rows: [1, 2], segments: [[1, 2]] },
  ]);
});

test("labels do not lie on one another, and the first one stays", () => {
  const boxes = [0, 5, 20].map((x) => ({ x, y: 0, width: 10, height: 10 }));
  assert.deepEqual(keepApart(boxes, (box) => box), [boxes[0], boxes[2]]);
});

test("of some buses the nearest is found", () => {
  assert.equal(nearest([[0, 0], [9, 9], [4, 5], [5, 4.9]], [0, 1, 2], [5, 5]), 2);
});

test("shares stay between the limits", () => {
  assert.deepEqual([0.8, 0.9, 1.0, 1.2].map((vm) => Number(shareOf(vm, [0.9, 1.1]).toFixed(3))), [0, 0, 0.5, 1]);
  assert.equal(shareOf(1, [1, 1]), 0.5);
});

test("an axis fits its values, and does not blow up rounding", () => {
  const [low, high] = spanOf(0.98, 1.0);
  assert.ok(low < 0.98 && low > 0.97 && high > 1.0 && high < 1.01);
  const [below, above] = spanOf(1, 1);
  assert.ok(below < 1 && above > 1 && above - below <= 0.0011);
  assert.deepEqual(spanOf(null, undefined), [0, 1]);
  assert.deepEqual(spanOf(NaN, 1), [0, 1]);
  assert.ok(spanOf(0, 0)[0] < spanOf(0, 0)[1]);
});

test("the usual length is that of a branch, and the middle that of all buses", () => {
  assert.equal(usualLength([[0, 0], [3, 4], [3, 5]], [[0, 1], [1, 2]]), 5);
  assert.equal(usualLength([], []), Infinity);
  assert.deepEqual(middle([[0, 0], [2, 4]], [0, 1]), [1, 2]);
});
