/** Where things lie on the canvas, and what axes span. Run by `make page-check`. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { edgesOf, findShapes, fitInto, heightOf, keepApart, middle, nearest, rangeOf, spanOf, stepOf, usualLength } from "./static/layout.js";

test("a feeder fills the canvas but for its margin, and one bus alone is no division by zero", () => {
  const { kx, ox, ky, oy } = fitInto([2, 6], [0, 10], 340, 240, 20);
  assert.deepEqual([2, 6].map((x) => kx * x + ox), [20, 320]);
  assert.deepEqual([0, 10].map((y) => ky * y + oy), [20, 220]);
  const alone = fitInto([3], [4], 440, 240, 20);
  assert.ok(Number.isFinite(alone.kx * 3 + alone.ox));
  assert.ok(Number.isFinite(fitInto([], [], 0, 0, 20).kx));
});

test("a small feeder is not stretched: it stands in the middle, and its canvas is as high as its rows need", () => {
  const { kx, ox, ky } = fitInto([0, 2], [0, 1], 1000, 420, 34);
  assert.deepEqual([kx, ky, kx + ox], [90, 90, 500]);
  const heightOfRows = (n) => heightOf({ buses: { y: [0, n - 1] } });
  assert.ok(heightOfRows(1) < heightOfRows(3) && heightOfRows(3) < heightOfRows(50));
  assert.equal(heightOfRows(50), heightOfRows(5000));
});

test("coordinates of a map have one scale, and north above", () => {
  const { kx, ky, oy } = fitInto([8.001, 8.002], [47.0, 47.001], 840, 440, 20, true);
  assert.equal(ky, -kx);
  assert.ok(Math.abs(kx - 400 / 0.001) < 1e-3);
  assert.ok(Math.abs(ky * 47.001 + oy - 20) < 1e-6);
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

test("steps of voltage stand about the nominal one, and tell 0.95 from 0.97", () => {
  const limits = { lowest_vm_pu: 0.9, highest_vm_pu: 1.1 };
  assert.deepEqual([0.7, 0.9, 0.95, 0.97, 0.999, 1, 1.03, 1.1, 1.4].map((vm) => stepOf(vm, limits)), [0, 0, 2, 3, 4, 5, 6, 9, 9]);
  assert.deepEqual(edgesOf(limits).map((edge) => Number(edge.toFixed(6))), [0.9, 0.92, 0.94, 0.96, 0.98, 1, 1.02, 1.04, 1.06, 1.08, 1.1]);
  const uneven = edgesOf({ lowest_vm_pu: 0.94, highest_vm_pu: 1.02 });
  assert.deepEqual([uneven[0], uneven[5]], [0.94, 1]);
});

test("a chart shows all times, the last ones, or those that were marked; a single one is not years", () => {
  assert.deepEqual(rangeOf([10, 20, 300], { length: Infinity, end: null }), [10, 300]);
  assert.deepEqual(rangeOf([10, 20, 300], { length: 60, end: null }), [240, 300]);
  assert.deepEqual(rangeOf([10, 20, 300], { length: 10, end: 25 }), [15, 25]);
  assert.deepEqual([rangeOf([7], { length: Infinity, end: null }), rangeOf([], { length: Infinity, end: null })], [[2, 12], [-5, 5]]);
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
