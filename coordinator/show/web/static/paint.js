/** Paints the feeder: areas as regions, branches by loading, buses by voltage, dead links, messages. */

import { gradeOf, placesOf } from "./cause.js";
import { entryOf, qualityClass } from "./format.js";
import { findShapes, keepApart, middle, nearest, placeBuses, stepOf, usualLength } from "./layout.js";
import { ALL, nameOf } from "./phases.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Painting} Painting @typedef {import("./types.js").Palette} Palette */
/** @typedef {import("./types.js").Cause} Cause */
/** @typedef {import("./layout.js").Shape} Shape @typedef {import("./layout.js").Point} Point */
/** @typedef {CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D} Context */
/** @typedef {{row: Map<number, number>, shapes: Shape[]}} Structure what of a grid is found once */
/** @typedef {Painting & Structure & {context: Context, at: Point[], width: number, height: number, spacing: number}} Canvas */

const MOST_NUMBERED = 150; // buses on the canvas that get their numbers
const SHADE_WIDTH = 24; // pixels of an area's shade, at most
const LEAST_RINGED = 3; // pixels of a bus; smaller ones are squares without a ring
const LABEL = 13; // pixels, height
const LONGEST_LABEL = 40;
const RINGED = 12; // pixels of the ring at a cause
const DOT = 5; // pixels of a message
const WAY_GAP = 27; // pixels beside the middles of areas: buses and their numbers stay legible
const WAY_WIDTH = 13; // pixels between two messages on one way

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
  for (const paint of [paintAreas, paintBranches, paintBuses, paintLinks, paintMessages, paintNames, paintCause]) paint(surface);
}

/** On a seam of paper, so that lines below it do not cross it out. @param {Canvas} canvas @param {string} text @param {number} x @param {number} y @param {string} ink */
function write({ context, palette }, text, x, y, ink) {
  context.strokeStyle = palette.colours["--paper"];
  context.lineWidth = 3;
  context.strokeText(text, x, y);
  context.fillStyle = palette.colours[ink];
  context.fillText(text, x, y);
}

/** Each in its colour, those that are not good above them in that of their quality. @param {Canvas} canvas */
function paintAreas(canvas) {
  const { context, shapes, at, palette, moment } = canvas;
  context.lineJoin = context.lineCap = "round";
  context.lineWidth = Math.min(SHADE_WIDTH, Math.max(4, canvas.spacing));
  const shades = shapes.map((shape, k) => {
    const quality = moment ? entryOf(moment.qualities, shape.name) ?? "none" : "good", isGood = quality === "good";
    const ink = isGood ? palette.areas[k % palette.areas.length] : palette.colours[qualityClass(quality) === "degraded" ? "--shade-degraded" : "--shade-bad"];
    return { shape, ink, isGood };
  });
  for (const { shape, ink, isGood } of shades.sort((one, other) => Number(other.isGood) - Number(one.isGood))) {
    if (!shape.rows.length) continue;
    context.globalAlpha = isGood ? 0.2 : 0.85;
    context.strokeStyle = ink;
    context.beginPath(); // one path: a shade that crosses itself is not darker there
    for (const [from, to] of shape.segments) {
      context.moveTo(...at[from]);
      context.lineTo(...at[to]);
    }
    if (!shape.segments.length) traceRow(context, shape.rows.map((row) => at[row]));
    context.stroke();
  }
  context.globalAlpha = 1;
  context.lineCap = "butt";
}

/** Of an area whose branches are not known: bus after bus. @param {Context} context @param {Point[]} points */
function traceRow(context, points) {
  context.moveTo(...points[0]);
  for (const point of points) context.lineTo(...point);
}

/** Above the bus in the middle of each area, with its quality unless it is good, or on a flag with the cause if it is one; the worst come first where there is no room for all. @param {Canvas} canvas */
function paintNames(canvas) {
  const { context, shapes, at, moment, width } = canvas;
  context.font = `600 ${LABEL - 1}px system-ui, sans-serif`;
  context.textAlign = "left";
  const cause = moment?.cause?.mark ? moment.cause : null, [place] = cause ? placesOf(cause) : [];
  const flagged = new Set(place?.[0] === "area" ? place[1] : []);
  const labels = shapes.filter((shape) => shape.rows.length).map((shape) => {
    const quality = (moment && entryOf(moment.qualities, shape.name)) ?? "none", isGood = quality === "good";
    const isFlag = flagged.has(shape.name), said = isFlag ? cause?.mark : isGood ? "" : quality, text = `${shape.name}${said ? `: ${said}` : ""}`.slice(0, LONGEST_LABEL);
    const wide = context.measureText(text).width, [left, top] = at[nearest(at, shape.rows, middle(at, shape.rows))];
    const x = Math.max(2, Math.min(width - wide - 2, left - wide / 2));
    return { text, quality, isFlag, x, y: Math.max(LABEL, top - (isFlag ? 20 : 16)), width: wide, height: LABEL };
  });
  const rank = (/** @type {{quality: string, isFlag: boolean}} */ { quality, isFlag }) => (isFlag ? -1 : ["bad", "degraded", "good"].indexOf(qualityClass(quality)));
  labels.sort((a, b) => rank(a) - rank(b));
  for (const label of keepApart(labels, (box) => box)) {
    if (label.isFlag && cause) paintFlag(canvas, cause, label);
    else write(canvas, label.text, label.x, label.y, `--${qualityClass(label.quality)}`);
  }
}

/** @param {Canvas} canvas */
function paintBranches({ context, grid, moment, choice, at, row, palette }) {
  const { branches } = grid, loading = moment?.loading ?? [], most = grid.operating_limits.most_loading_percent;
  const named = new Set(moment?.cause?.branches);
  /** @type {Map<string, [Point, Point][]>} */ const alike = new Map();
  branches.id.forEach((id, k) => {
    const from = row.get(branches.from_bus[k]), to = row.get(branches.to_bus[k]);
    if (from === undefined || to === undefined) return;
    const isFresh = moment?.freshBranches[k] ?? false, percent = isFresh ? Number(loading[k]?.value ?? 0) : 0, isChosen = choice?.kind === "branch" && choice.id === id;
    const wide = named.has(id) ? 7 : isChosen ? 5 : Math.round(2 * (1.5 + 2.5 * Math.min(1, percent / most))) / 2;
    const ink = percent > most || named.has(id) ? "--bad" : isChosen ? "--mark" : isFresh ? "--faint" : "--line";
    const status = moment?.switches?.[id], isClosed = status ? status === "closed" : branches.in_service[k];
    const style = `${ink} ${wide} ${isClosed ? 0 : 4}`;
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
  const { context, grid, at, palette, width, height } = canvas, phases = canvas.moment?.worst;
  /** @type {(number | null)[]} */ const values = grid.buses.id.map((_, k) => phases?.[k]?.value ?? null); // p.u.; null where none of now is known
  const n = grid.buses.id.length, size = n > 1500 ? 2 : n > 300 ? 3.5 : 5;
  const seen = at.flatMap(([x, y], k) => (x > -9 && y > -9 && x < width + 9 && y < height + 9 ? [k] : []));
  const { lowest_vm_pu: low, highest_vm_pu: high } = grid.operating_limits;
  const sideOf = (/** @type {number} */ k) => Number((values[k] ?? low) > high) - Number((values[k] ?? high) < low);
  const colours = [...palette.voltages, palette.colours["--paper"]]; // hollow where none is known now
  /** @type {number[][]} */ const steps = colours.map(() => []); // buses of one step are painted at once
  for (const k of seen) {
    const value = values[k];
    if (!sideOf(k)) steps[value === null ? palette.voltages.length : stepOf(value, grid.operating_limits)].push(k);
  }
  context.strokeStyle = palette.colours["--faint"];
  for (const [step, rows] of steps.entries()) {
    context.fillStyle = colours[step];
    context.lineWidth = step < palette.voltages.length ? 0.75 : 1.5;
    context.beginPath();
    for (const k of rows) traceBus(context, at[k], size);
    context.fill();
    if (size >= LEAST_RINGED || step === palette.voltages.length) context.stroke();
  }
  paintRings(canvas, seen, size);
  paintOutside(canvas, seen.map((k) => [k, sideOf(k)]), size);
  if (seen.length > MOST_NUMBERED) return;
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "center";
  const ringed = new Set(findRinged(canvas)), chosen = canvas.choice?.kind === "bus" ? canvas.choice.id : null;
  const reachOf = (/** @type {number} */ k) => (ringed.has(k) || String(grid.buses.id[k]) === chosen ? RINGED : grid.buses.areas[k].length > 1 ? size + 5 : size);
  const numbers = seen.map((k) => ({ text: nameOf(String(grid.buses.id[k]), phases?.[k]?.phase ?? ALL), x: at[k][0], y: at[k][1] + reachOf(k) + 12, reach: reachOf(k) })).sort((one, other) => other.reach - one.reach);
  const boxOf = (/** @type {{text: string, x: number, y: number}} */ { text, x, y }) => {
    const wide = context.measureText(text).width;
    return { x: x - wide / 2, y, width: wide, height: LABEL - 2 };
  };
  for (const { text, x, y } of keepApart(numbers, boxOf)) write(canvas, text, x, y, "--ink");
}

/** @param {Context} context @param {Point} point @param {number} size */
function traceBus(context, [x, y], size) {
  if (size < LEAST_RINGED) {
    context.rect(x - size, y - size, 2 * size, 2 * size);
    return;
  }
  context.moveTo(x + size, y);
  context.arc(x, y, size, 0, 2 * Math.PI);
}

/** Around boundary buses, and the chosen one. @param {Canvas} canvas @param {number[]} seen @param {number} size */
function paintRings({ context, grid, choice, at, palette }, seen, size) {
  const chosen = choice?.kind === "bus" ? choice.id : null;
  const rings = [
    { ink: "--ink", wide: 1.5, more: 3, rows: seen.filter((k) => grid.buses.areas[k].length > 1) },
    { ink: "--mark", wide: 3, more: 6, rows: seen.filter((k) => String(grid.buses.id[k]) === chosen) },
  ];
  for (const { ink, wide, more, rows } of rings) {
    context.strokeStyle = palette.colours[ink];
    context.lineWidth = wide;
    context.beginPath();
    for (const k of rows) traceBus(context, at[k], Math.max(size, LEAST_RINGED) + more);
    context.stroke();
  }
}

/** A triangle that points up above the limits, down below them. @param {Canvas} canvas @param {[number, number][]} sides row and 1 above, -1 below, 0 within @param {number} size */
function paintOutside({ context, at, palette }, sides, size) {
  const half = size + 2;
  context.fillStyle = palette.colours["--bad"];
  context.strokeStyle = palette.colours["--paper"];
  context.lineWidth = 1;
  context.beginPath();
  for (const [row, side] of sides) {
    if (!side) continue;
    const [x, y] = at[row];
    context.moveTo(x - half, y + side * half);
    context.lineTo(x + half, y + side * half);
    context.lineTo(x, y - side * half);
    context.closePath();
  }
  context.fill();
  context.stroke();
}

/** A cross where nothing is received over a boundary, and between whom. @param {Canvas} canvas */
function paintLinks(canvas) {
  const { context, grid, moment, at, row, palette, width, height } = canvas;
  const boundary = new Map(grid.areas.flatMap((a) => a.neighbours.map((n) => [`${a.name} ${n.area}`, n.bus])));
  const find = (/** @type {string} */ receiver, /** @type {string} */ sender) => row.get(boundary.get(`${receiver} ${sender}`) ?? NaN);
  context.strokeStyle = palette.colours["--degraded"];
  context.lineWidth = 3;
  context.beginPath();
  for (const { receiver, sender } of moment?.dead ?? []) {
    const place = find(receiver, sender);
    if (place === undefined) continue;
    const [x, y] = at[place];
    context.moveTo(x - 8, y - 8);
    context.lineTo(x + 8, y + 8);
    context.moveTo(x + 8, y - 8);
    context.lineTo(x - 8, y + 8);
  }
  context.stroke();
  context.font = `600 ${LABEL - 2}px system-ui, sans-serif`;
  context.textAlign = "left";
  /** @type {Map<number, number>} */ const below = new Map(); // how many labels a bus has already
  const labels = (moment?.dead ?? []).flatMap(({ receiver, sender, text }) => {
    const place = find(receiver, sender), named = moment?.cause?.areas ?? [];
    if (place === undefined || (named.includes(receiver) && named.includes(sender))) return []; // the flag says it
    const line = below.get(place) ?? 0, wide = context.measureText(text).width;
    below.set(place, line + 1);
    const [x, y] = at[place], left = Math.max(2, Math.min(width - wide - 2, x + 12));
    return [{ text, x: left, y: Math.min(height - 4, y + 34 + line * (LABEL + 2)), width: wide, height: LABEL }];
  });
  for (const { text, x, y } of keepApart(labels, (box) => box)) write(canvas, text, x, y, "--degraded");
}

/** Dots on the way from one area to the other, those of one way beside each other. @param {Canvas} canvas */
function paintMessages(canvas) {
  const { context, moment, shapes, at, palette } = canvas;
  if (!moment?.messages.length) return;
  const centre = new Map(shapes.filter((shape) => shape.rows.length).map((shape) => [shape.name, at[nearest(at, shape.rows, middle(at, shape.rows))]]));
  context.font = `600 ${LABEL - 2}px system-ui, sans-serif`;
  context.textAlign = "left";
  context.lineWidth = 1;
  /** @type {Map<string, number>} */ const beside = new Map(); // how many are painted on each way
  const labels = [];
  for (const message of moment.messages) {
    const from = centre.get(message.from), to = centre.get(message.to);
    if (!from || !to) continue;
    const [dx, dy] = [to[0] - from[0], to[1] - from[1]], far = Math.hypot(dx, dy) || 1, way = `${message.from} ${message.to}`;
    const place = beside.get(way) ?? 0, aside = WAY_GAP + WAY_WIDTH * place; // to the right of who goes there
    beside.set(way, place + 1);
    const [x0, y0] = [from[0] - (aside * dy) / far, from[1] + (aside * dx) / far];
    const share = message.lost ? 0.5 : message.arrived === null ? 0.35 : 0.85, x = x0 + share * dx, y = y0 + share * dy;
    context.fillStyle = context.strokeStyle = palette.colours[message.lost ? "--bad" : "--mark"];
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x0 + dx, y0 + dy);
    context.stroke();
    context.beginPath();
    context.arc(x, y, DOT, 0, 2 * Math.PI);
    context.fill();
    const text = message.lost ? `${message.kind} lost` : message.kind;
    labels.push({ text, x: x + DOT + 3, y: y + 4, width: context.measureText(text).width, height: LABEL - 2 });
  }
  for (const { text, x, y } of keepApart(labels, (box) => box)) write(canvas, text, x, y, "--ink");
}

/** @param {Canvas} canvas @param {Cause} cause @param {{text: string, x: number, y: number, width: number}} box */
function paintFlag({ context, palette }, cause, { text, x, y, width }) {
  context.fillStyle = palette.colours[`--${gradeOf(cause)}`];
  context.fillRect(x - 6, y - LABEL, width + 12, LABEL + 6);
  context.fillStyle = palette.colours["--paper"];
  context.fillText(text, x, y);
}

/** The place of the first cause unless it is an area: its buses in bold rings, and a flag there. @param {Canvas} canvas */
function paintCause(canvas) {
  const { context, moment, at, palette, width } = canvas, cause = moment?.cause, rows = findRinged(canvas);
  if (!cause || !rows.length) return;
  const [[kind, ids]] = placesOf(cause), [x, y] = kind === "branch" && ids.length === 1 ? middle(at, rows) : at[rows[0]];
  context.strokeStyle = palette.colours[`--${gradeOf(cause)}`];
  context.lineWidth = 4;
  context.beginPath();
  for (const place of rows) traceBus(context, at[place], RINGED);
  context.stroke();
  const name = kind === "bus" ? nameOf(ids[0], moment.worst[rows[0]]?.phase ?? ALL) : ids[0];
  const text = `${kind === "meter" ? `${name}: ` : cause.scope === "grid" ? `${kind} ${name}: ` : ""}${cause.mark}`.slice(0, LONGEST_LABEL);
  context.font = `600 ${LABEL - 1}px system-ui, sans-serif`;
  context.textAlign = "left";
  const wide = context.measureText(text).width, left = Math.max(8, Math.min(width - wide - 8, x - wide / 2)), top = Math.max(LABEL + 2, y - 38);
  context.fillStyle = palette.colours[`--${gradeOf(cause)}`];
  context.beginPath();
  context.moveTo(x, y - RINGED - 1);
  context.lineTo(Math.max(left, x - 6), top + 5);
  context.lineTo(Math.min(left + wide, x + 6), top + 5);
  context.closePath();
  context.fill();
  paintFlag(canvas, cause, { text, x: left, y: top, width: wide });
}

/** @param {Canvas} canvas @returns {number[]} rows of the buses that the first cause rings */
function findRinged(canvas) {
  const cause = canvas.moment?.cause;
  return cause?.mark && placesOf(cause)[0]?.[0] !== "area" ? findPlaces(canvas, cause) : [];
}

/** Buses or ends of branches where a cause is. @param {Canvas} canvas @param {Cause} cause @returns {number[]} their rows */
function findPlaces({ grid, row }, cause) {
  const rowOf = (/** @type {number} */ bus) => row.get(bus) ?? [];
  for (const [kind, ids] of placesOf(cause)) {
    const named = new Set(ids);
    const rows = kind === "bus" ? cause.buses.flatMap(rowOf)
      : kind === "branch" ? grid.branches.id.flatMap((id, k) => (named.has(id) ? [grid.branches.from_bus[k], grid.branches.to_bus[k]] : [])).flatMap(rowOf)
      : [];
    if (rows.length) return rows;
  }
  return [];
}
