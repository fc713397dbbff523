/** Paints the feeder: areas as regions, branches by loading, buses by voltage, dead links, messages. */

import { findShapes, keepApart, middle, placeBuses, shareOf, usualLength } from "./layout.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Painting} Painting @typedef {import("./types.js").Palette} Palette */
/** @typedef {import("./layout.js").Shape} Shape @typedef {import("./layout.js").Point} Point */
/** @typedef {CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D} Context */
/** @typedef {{row: Map<number, number>, shapes: Shape[]}} Structure what of a grid is found once */
/** @typedef {Painting & Structure & {context: Context, at: Point[], width: number, height: number, spacing: number}} Canvas */

const FULL_LOADING = 100; // percent
const MOST_NUMBERED = 150; // buses on the canvas that get their numbers
const SHADE_WIDTH = 24; // pixels of an area's shade, at most
const LABEL = 13; // pixels, height
const LONGEST_LABEL = 40;

/** @param {Grid} grid @returns {Structure} */
export function findStructure(grid) {
  return { row: new Map(grid.buses.id.map((bus, k) => [bus, k])), shapes: findShapes(grid) };
}

/** @param {HTMLCanvasElement | OffscreenCanvas} canvas @param {Painting} painting @param {Structure} structure */
export function paintFeeder(canvas, painting, structure) {
  const { width, height, ratio } = painting.view, wide = Math.round(width * ratio), high = Math.round(height * ratio);
  if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
  const context = /** @type {Context | null} */ (canvas.getContext("2d"));
  if (!context) return;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const at = placeBuses(painting.grid, painting.view);
  const spacing = usualLength(at, structure.shapes.flatMap((shape) => shape.segments));
  const surface = { ...painting, ...structure, context, at, width, height, spacing };
  for (const paint of [paintAreas, paintBranches, paintBuses, paintLinks, paintMessages]) paint(surface);
}

/** @param {Canvas} canvas */
function paintAreas(canvas) {
  const { context, shapes, at, palette } = canvas;
  context.lineJoin = context.lineCap = "round";
  context.lineWidth = Math.min(SHADE_WIDTH, Math.max(4, canvas.spacing));
  context.globalAlpha = 0.2;
  shapes.forEach((shape, k) => {
    if (!shape.rows.length) return;
    context.strokeStyle = palette.areas[k % palette.areas.length];
    context.beginPath(); // one path: a shade that crosses itself is not darker there
    for (const [from, to] of shape.segments) {
      context.moveTo(...at[from]);
      context.lineTo(...at[to]);
    }
    if (!shape.segments.length) traceRow(context, shape.rows.map((row) => at[row]));
    context.stroke();
  });
  context.globalAlpha = 1;
  context.lineCap = "butt";
  paintNames(canvas);
}

/** Of an area whose branches are not known: bus after bus. @param {Context} context @param {Point[]} points */
function traceRow(context, points) {
  context.moveTo(...points[0]);
  for (const point of points) context.lineTo(...point);
}

/** Those that are not good come first where there is no room for all. @param {Canvas} canvas */
function paintNames({ context, shapes, at, moment, palette, width }) {
  context.font = `600 ${LABEL - 1}px system-ui, sans-serif`;
  context.textAlign = "left";
  const labels = shapes.filter((shape) => shape.rows.length).map((shape) => {
    const quality = moment?.qualities[shape.name] ?? "none", text = `${shape.name}: ${quality}`.slice(0, LONGEST_LABEL);
    const wide = context.measureText(text).width, top = Math.min(...shape.rows.map((row) => at[row][1]));
    const x = Math.max(2, Math.min(width - wide - 2, middle(at, shape.rows)[0] - wide / 2));
    return { text, quality, x, y: Math.max(LABEL, top - 16), width: wide, height: LABEL };
  });
  labels.sort((a, b) => Number(a.quality === "good") - Number(b.quality === "good"));
  for (const label of keepApart(labels, (box) => box)) {
    context.fillStyle = palette.colours[label.quality === "good" ? "--good" : label.quality === "degraded" ? "--degraded" : "--bad"];
    context.fillText(label.text, label.x, label.y);
  }
}

/** @param {Canvas} canvas */
function paintBranches({ context, grid, moment, choice, at, row, palette }) {
  const { branches } = grid, loading = moment?.loading ?? [];
  /** @type {Map<string, [Point, Point][]>} */ const alike = new Map();
  branches.id.forEach((id, k) => {
    const from = row.get(branches.from_bus[k]), to = row.get(branches.to_bus[k]);
    if (from === undefined || to === undefined) return;
    const percent = Number(loading[k] ?? 0), isChosen = choice?.kind === "branch" && choice.id === id;
    const wide = isChosen ? 5 : Math.round(2 * (1.5 + 2.5 * Math.min(1, percent / FULL_LOADING))) / 2;
    const ink = isChosen ? "--mark" : percent > FULL_LOADING ? "--bad" : "--faint";
    const style = `${ink} ${wide} ${branches.in_service[k] ? 0 : 4}`;
    const found = alike.get(style);
    if (found) found.push([at[from], at[to]]);
    else alike.set(style, [[at[from], at[to]]]);
  });
  for (const [style, lines] of alike) {
    const [ink, wide, dash] = style.split(" ");
    context.strokeStyle = palette.colours[ink];
    context.lineWidth = Number(wide);
    context.setLineDash(dash === "0" ? [] : [4, 4]);
    context.beginPath();
    for (const [from, to] of lines) {
      context.moveTo(...from);
      context.lineTo(...to);
    }
    context.stroke();
  }
  context.setLineDash([]);
}

/** @param {Canvas} canvas */
function paintBuses(canvas) {
  const { context, grid, at, palette, width, height } = canvas, values = voltagesOf(canvas);
  const n = grid.buses.id.length, size = n > 1500 ? 2 : n > 300 ? 3.5 : 5;
  const seen = at.flatMap(([x, y], k) => (x > -9 && y > -9 && x < width + 9 && y < height + 9 ? [k] : []));
  const colours = [...palette.voltages, palette.colours["--line"]]; // the last where it is not known
  /** @type {number[][]} */ const steps = colours.map(() => []); // buses of one step are painted at once
  for (const k of seen) steps[stepOf(values[k], grid.limits, palette.voltages.length)].push(k);
  for (const [step, rows] of steps.entries()) {
    context.fillStyle = colours[step];
    context.beginPath();
    for (const k of rows) traceBus(context, at[k], size);
    context.fill();
  }
  paintRings(canvas, seen, values, size);
  if (seen.length > MOST_NUMBERED) return;
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillStyle = palette.colours["--ink"];
  for (const k of seen) context.fillText(String(grid.buses.id[k]), at[k][0], at[k][1] + size + 12);
}

/** @param {Canvas} canvas @returns {(number | null)[]} p.u., of each bus of the grid; null if it is not known */
function voltagesOf({ grid, moment, row }) {
  /** @type {(number | null)[]} */ const values = grid.buses.id.map(() => null);
  moment?.bus.forEach((bus, k) => {
    const place = row.get(bus);
    if (place !== undefined) values[place] = moment.vm[k] ?? null;
  });
  return values;
}

/** @param {number | null} value @param {Point} limits @param {number} steps @returns {number} of as many; `steps` if it is not known */
function stepOf(value, limits, steps) {
  return value === null ? steps : Math.round(shareOf(value, limits) * (steps - 1));
}

/** @param {Context} context @param {Point} point @param {number} size */
function traceBus(context, [x, y], size) {
  if (size < 3) {
    context.rect(x - size, y - size, 2 * size, 2 * size);
    return;
  }
  context.moveTo(x + size, y);
  context.arc(x, y, size, 0, 2 * Math.PI);
}

/** Around boundary buses, those outside the limits, and the chosen one. @param {Canvas} canvas @param {number[]} seen @param {(number | null)[]} values @param {number} size */
function paintRings({ context, grid, choice, at, palette }, seen, values, size) {
  const [low, high] = grid.limits, chosen = choice?.kind === "bus" ? choice.id : null;
  const isOutside = (/** @type {number} */ k) => values[k] !== null && (/** @type {number} */ (values[k]) < low || /** @type {number} */ (values[k]) > high);
  const rings = [
    { ink: "--ink", wide: 1.5, more: 0, rows: seen.filter((k) => grid.buses.areas[k].length > 1 && !isOutside(k)) },
    { ink: "--bad", wide: 2, more: 0, rows: seen.filter(isOutside) },
    { ink: "--mark", wide: 3, more: 4, rows: seen.filter((k) => String(grid.buses.id[k]) === chosen) },
  ];
  for (const { ink, wide, more, rows } of rings) {
    context.strokeStyle = palette.colours[ink];
    context.lineWidth = wide;
    context.beginPath();
    for (const k of rows) traceBus(context, at[k], size + more);
    context.stroke();
  }
}

/** A cross where nothing is received over a boundary. @param {Canvas} canvas */
function paintLinks({ context, grid, moment, at, row, palette }) {
  const boundary = new Map(grid.areas.flatMap((a) => a.neighbours.map((n) => [`${a.name} ${n.area}`, n.bus])));
  context.strokeStyle = palette.colours["--bad"];
  context.lineWidth = 3;
  context.beginPath();
  for (const link of moment?.links ?? []) {
    const place = row.get(boundary.get(`${link.to} ${link.from}`) ?? NaN);
    if (place === undefined || link.alive) continue;
    const [x, y] = at[place];
    context.moveTo(x - 8, y - 8);
    context.lineTo(x + 8, y + 8);
    context.moveTo(x + 8, y - 8);
    context.lineTo(x - 8, y + 8);
  }
  context.stroke();
}

/** Dots between the middles of two areas. @param {Canvas} canvas */
function paintMessages({ context, moment, shapes, at, palette }) {
  if (!moment?.messages.length) return;
  const centre = new Map(shapes.filter((shape) => shape.rows.length).map((shape) => [shape.name, middle(at, shape.rows)]));
  context.font = "600 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.lineWidth = 1;
  for (const message of moment.messages) {
    const from = centre.get(message.from), to = centre.get(message.to);
    if (!from || !to) continue;
    const way = message.lost ? 0.5 : message.arrived === null ? 0.35 : 0.85;
    const x = from[0] + way * (to[0] - from[0]), y = from[1] + way * (to[1] - from[1]);
    context.fillStyle = context.strokeStyle = palette.colours[message.lost ? "--bad" : "--mark"];
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
    context.beginPath();
    context.arc(x, y, 7, 0, 2 * Math.PI);
    context.fill();
    context.fillStyle = palette.colours["--ink"];
    context.fillText(message.lost ? `${message.kind} lost` : message.kind, x, y - 10);
  }
}
