/** Where things lie on the canvas. No canvas, no document: numbers in, numbers out. */

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").View} View @typedef {import("./types.js").Limits} Limits */
/** @typedef {[number, number]} Point */
/** @typedef {{length: number, end: number | null}} Range seconds that are shown, up to `end`; null: up to the newest */
/** @typedef {{kx: number, ox: number, ky: number, oy: number}} Fit pixels = k * coordinate + o */
/**
 * @typedef {{name: string, rows: number[], segments: [number, number][]}} Shape
 * rows of the buses of an area, and of both ends of its branches
 */

const MARGIN = 34; // pixels around the whole feeder
const LONGEST = 90; // pixels between two columns, and between two rows
const LOWEST = 180, HIGHEST = 420; // pixels of the canvas
const MOMENT_S = 5; // to either side of a single moment
const STEPS = 5; // of voltage on either side of the nominal one

/**
 * The scales that bring all of a feeder into the middle of a canvas: as wide and as high as it is drawn, but never more
 * than `LONGEST` pixels for a column or a row. Coordinates of a map have one scale, and north above.
 * @param {number[]} x @param {number[]} y @param {number} width @param {number} height @param {number} margin pixels
 * @param {boolean} isMap
 * @returns {Fit}
 */
export function fitInto(x, y, width, height, margin, isMap = false) {
  const [left, right] = extent(x), [top, bottom] = extent(y), most = isMap ? Infinity : LONGEST, least = isMap ? 1e-9 : 1;
  let kx = Math.min(most, Math.max(1, width - 2 * margin) / Math.max(right - left, least));
  let ky = Math.min(most, Math.max(1, height - 2 * margin) / Math.max(bottom - top, least));
  if (isMap) [kx, ky] = [Math.min(kx, ky), -Math.min(kx, ky)];
  return { kx, ox: width / 2 - (kx * (left + right)) / 2, ky, oy: height / 2 - (ky * (top + bottom)) / 2 };
}

/** @param {Grid} grid @returns {number} pixels that its rows need, at most what a screen has for them */
export function heightOf({ buses, is_map: isMap }) {
  const [top, bottom] = extent(buses.y);
  return isMap ? HIGHEST : Math.min(HIGHEST, Math.max(LOWEST, LONGEST * (bottom - top) + 2 * MARGIN));
}

/**
 * All buses of a grid, as they are zoomed.
 * @param {Grid} grid @param {View} view @returns {Point[]} pixels
 */
export function placeBuses(grid, { width, height, transform }) {
  const { x, y } = grid.buses, { kx, ox, ky, oy } = fitInto(x, y, width, height, Math.min(MARGIN, width / 16), grid.is_map);
  const { k, x: left, y: top } = transform;
  return x.map((value, row) => [k * (kx * value + ox) + left, k * (ky * y[row] + oy) + top]);
}

/** @param {number[]} values @returns {Point} */
function extent(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return values.length ? [low, high] : [0, 1];
}

/** @param {Grid} grid @returns {Shape[]} what each area consists of, as far as it is on the drawing */
export function findShapes(grid) {
  const row = new Map(grid.buses.id.map((bus, k) => [bus, k]));
  /** @type {Map<string, [number, number][]>} */ const segments = new Map(grid.areas.map((area) => [area.name, []]));
  grid.branches.area.forEach((area, k) => {
    const from = row.get(grid.branches.from_bus[k]), to = row.get(grid.branches.to_bus[k]);
    if (from !== undefined && to !== undefined) segments.get(area)?.push([from, to]);
  });
  return grid.areas.map((area) => ({
    name: area.name,
    rows: area.buses.flatMap((bus) => row.get(bus) ?? []),
    segments: segments.get(area.name) ?? [],
  }));
}

/** @param {Point[]} at @param {[number, number][]} segments @returns {number} the usual length of one, in pixels */
export function usualLength(at, segments) {
  const lengths = segments.map(([a, b]) => Math.hypot(at[a][0] - at[b][0], at[a][1] - at[b][1])).sort((a, b) => a - b);
  return lengths.length ? lengths[lengths.length >> 1] : Infinity;
}

/** @param {Point[]} at @param {number[]} rows @returns {Point} the middle of some buses */
export function middle(at, rows) {
  let x = 0, y = 0;
  for (const row of rows) {
    x += at[row][0];
    y += at[row][1];
  }
  return [x / rows.length, y / rows.length];
}

/** @param {Point[]} at @param {number[]} rows @param {Point} point @returns {number} the row of the bus that is nearest to it */
export function nearest(at, rows, [x, y]) {
  const far = (/** @type {number} */ row) => Math.hypot(at[row][0] - x, at[row][1] - y);
  return rows.reduce((best, row) => (far(row) < far(best) ? row : best));
}

/**
 * The labels that do not lie on one another: earlier ones first.
 * @template T @param {T[]} labels @param {(label: T) => {x: number, y: number, width: number, height: number}} boxOf
 * @returns {T[]}
 */
export function keepApart(labels, boxOf) {
  /** @type {{x: number, y: number, width: number, height: number}[]} */ const taken = [];
  return labels.filter((label) => {
    const box = boxOf(label);
    const free = taken.every((other) =>
      box.x + box.width < other.x || other.x + other.width < box.x || box.y + box.height < other.y || other.y + other.height < box.y);
    if (free) taken.push(box);
    return free;
  });
}

/**
 * The step of a voltage on a scale about the nominal one: as many steps below it as above, to the farther limit.
 * @param {number} value @param {Limits} limits @returns {number} from 0, and below `2 * STEPS`
 */
export function stepOf(value, limits) {
  const far = (value - 1) / halfOf(limits), step = STEPS + Math.floor(STEPS * far + 1e-9);
  return Math.min(2 * STEPS - 1, Math.max(0, step));
}

/** @param {Limits} limits @returns {number[]} p.u., where one step ends and the next begins, with both ends */
export function edgesOf(limits) {
  return Array.from({ length: 2 * STEPS + 1 }, (_, k) => 1 + (halfOf(limits) * (k - STEPS)) / STEPS);
}

/** @param {Limits} limits @returns {number} p.u. from the nominal voltage to the farther limit */
function halfOf({ lowest_vm_pu: low, highest_vm_pu: high }) {
  return Math.max(1 - low, high - 1) || 1;
}

/**
 * The times that a chart shows; where there is but one uPlot would show years.
 * @param {number[]} times @param {Range} range @returns {Point}
 */
export function rangeOf(times, { length, end }) {
  const first = times[0] ?? 0, last = times.at(-1) ?? first;
  if (!Number.isFinite(length)) return last > first ? [first, last] : [first - MOMENT_S, first + MOMENT_S];
  const to = end ?? last;
  return [to - length, to];
}

/**
 * What an axis spans: all values and a tenth to either side, and never so little that rounding shows as change.
 * @param {number | null | undefined} low @param {number | null | undefined} high @returns {Point}
 */
export function spanOf(low, high) {
  if (low === null || low === undefined || high === null || high === undefined || !Number.isFinite(low + high)) return [0, 1];
  const least = Math.max(Math.abs(low), Math.abs(high)) * 1e-3 || 1e-3, pad = Math.max((high - low) * 0.1, (least - (high - low)) / 2);
  return [low - pad, high + pad];
}
