/** The thread that paints the feeder: a drawing, however large, keeps nobody waiting who clicks or types. */

import { findStructure, paintFeeder } from "./paint.js";

/** @typedef {import("./types.js").Painting} Painting @typedef {import("./types.js").PaintOrder} PaintOrder */

/** @type {OffscreenCanvas | null} */ let canvas = null;
/** @type {import("./paint.js").Structure | null} */ let structure = null;
let painting = /** @type {Painting} */ ({});
let planned = 0;

function paint() {
  planned = 0;
  if (canvas && structure && painting.view.width) paintFeeder(canvas, painting, structure);
}

/** Takes what has changed, and paints once, with the next picture. @param {MessageEvent<PaintOrder>} event */
self.onmessage = ({ data }) => {
  if (data.canvas) canvas = data.canvas;
  if (data.changed.grid) structure = findStructure(data.changed.grid);
  painting = { ...painting, ...data.changed };
  planned ||= requestAnimationFrame(paint);
};
