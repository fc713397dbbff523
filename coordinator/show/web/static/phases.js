/** Nodes and conductors: the phases of buses and branches, and how each is drawn. No document, no canvas. */

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Columns} Columns */
/** @typedef {{ink: string, dash: number[], shape: "square"|"disc"|"triangle"|"diamond"|"cross", sign: string}} Look `sign`: the shape in a text */
/** @typedef {{value: number|null, phase: string}} Chosen the number of one phase, null where none of now is known */

export const ALL = "abc"; // the phase of rows of a network without phases, and of totals
/** @type {Record<string, Look>} */ const LOOKS = { // each by its colour, its dashes and its shape
  [ALL]: { ink: "--mark", dash: [], shape: "square", sign: "" },
  a: { ink: "--phase-a", dash: [], shape: "square", sign: "■" },
  b: { ink: "--phase-b", dash: [7, 3], shape: "disc", sign: "●" },
  c: { ink: "--phase-c", dash: [2, 3], shape: "triangle", sign: "▲" },
  s1: { ink: "--phase-s1", dash: [], shape: "diamond", sign: "◆" },
  s2: { ink: "--phase-s2", dash: [7, 3], shape: "cross", sign: "✚" },
};

/** @param {string} phase @returns {Look} */
export function lookOf(phase) {
  return Object.hasOwn(LOOKS, phase) ? LOOKS[phase] : LOOKS[ALL];
}

/** @param {Grid} grid @returns {{bus: number[], phase: string[]}} the nodes of a grid: without phases its buses */
export function nodesOf({ nodes, buses }) {
  return nodes ?? { bus: buses.id, phase: buses.id.map(() => ALL) };
}

/** @param {Grid} grid @returns {{branch: string[], phase: string[]}} the conductors of a known grid: without phases its branches */
export function conductorsOf({ conductors, branches }) {
  return conductors ?? { branch: branches.id, phase: branches.id.map(() => ALL) };
}

/** @param {string} id @param {string} phase @returns {string} such as 671.a; without phases the id */
export function nameOf(id, phase) {
  return phase === ALL ? id : `${id}.${phase}`;
}

/** @param {Grid} grid @param {Pick<Moment, "buses"|"worst_nodes">} moment @returns {Chosen[]} of each bus the voltage by which it is judged, in the order of the grid */
export function worstVoltages(grid, { buses, worst_nodes }) {
  const nodes = nodesOf(grid), worst = new Set(worst_nodes);
  const shown = worst_nodes ? buses.fresh.map((_, k) => worst.has(k)) : buses.fresh;
  return pickEach(grid.buses.id, buses.id ?? nodes.bus, buses.phase ?? nodes.phase, shown, buses.vm_pu);
}

/** @param {Grid} grid @param {Columns} branches of a moment @returns {Chosen[]} of each branch the largest loading, in the order of the grid */
export function largestLoadings(grid, branches) {
  const { branch, phase } = conductorsOf(grid);
  return pickEach(grid.branches.id, branch, phase, branches.fresh, branches.loading_percent);
}

/**
 * Of each of `ids` the largest fresh value.
 * @param {(number|string)[]} ids @param {unknown[]} of the id of each row @param {unknown[]} phase @param {unknown[] | undefined} fresh @param {unknown[] | undefined} values
 * @returns {Chosen[]}
 */
function pickEach(ids, of, phase, fresh, values) {
  /** @type {Map<unknown, Chosen>} */ const found = new Map(ids.map((id) => [id, { value: null, phase: ALL }]));
  of.forEach((id, k) => {
    const value = values?.[k], best = found.get(id);
    if (!best || !fresh?.[k] || typeof value !== "number") return;
    if (best.value === null || value > best.value) [best.value, best.phase] = [value, String(phase[k] ?? ALL)];
  });
  return ids.map((id) => /** @type {Chosen} */ (found.get(id)));
}

/** @param {Grid} grid @param {Columns} branches of a moment @returns {boolean[]} of each branch, in the order of the grid: its numbers are of now */
export function freshBranches(grid, branches) {
  const { branch } = conductorsOf(grid), fresh = new Set(branch.filter((_, k) => branches.fresh?.[k]));
  return grid.branches.id.map((id) => fresh.has(id));
}

/**
 * Pairs of nodes that a conductor joins: of the same phase at both ends of a branch; where windings change phases, as at a
 * centre-tapped transformer, the only one of the one end with each of the other.
 * @param {Grid} grid @returns {[number, number][]} rows of nodes
 */
export function joinNodes(grid) {
  const { bus, phase } = nodesOf(grid), { branches } = grid, conductors = conductorsOf(grid);
  const row = new Map(bus.map((id, k) => [nameOf(String(id), phase[k]), k])), place = new Map(branches.id.map((id, k) => [id, k]));
  /** @type {Map<number, {from: number[], to: number[]}>} */ const open = new Map(); // conductors with one end
  /** @type {[number, number][]} */ const joined = [];
  conductors.branch.forEach((id, n) => {
    const k = place.get(id);
    if (k === undefined || !branches.in_service[k]) return;
    const [from, to] = [branches.from_bus[k], branches.to_bus[k]].map((end) => row.get(nameOf(String(end), conductors.phase[n])));
    if (from !== undefined && to !== undefined) return void joined.push([from, to]);
    const ends = open.get(k) ?? { from: [], to: [] };
    open.set(k, ends);
    if (from !== undefined) ends.from.push(from);
    if (to !== undefined) ends.to.push(to);
  });
  const changed = [...open.values()].filter(({ from, to }) => from.length === 1 || to.length === 1);
  return [...joined, ...changed.flatMap(({ from, to }) => from.flatMap((one) => to.map((other) => /** @type {[number, number]} */ ([one, other]))))];
}

/**
 * Traces the shape of a phase about a point.
 * @param {CanvasRenderingContext2D | Path2D} path @param {Look["shape"]} shape @param {number} x @param {number} y @param {number} size pixels across
 */
export function traceShape(path, shape, x, y, size) {
  const half = size / 2;
  if (shape === "square") return path.rect(x - half, y - half, size, size);
  if (shape === "disc") {
    path.moveTo(x + half, y);
    return path.arc(x, y, half, 0, 2 * Math.PI);
  }
  /** @type {Record<string, [number, number][]>} */ const corners = {
    triangle: [[0, -1.2], [1.2, 1], [-1.2, 1]], diamond: [[0, -1.4], [1.4, 0], [0, 1.4], [-1.4, 0]],
    cross: [[-1.3, -0.5], [-0.5, -0.5], [-0.5, -1.3], [0.5, -1.3], [0.5, -0.5], [1.3, -0.5], [1.3, 0.5], [0.5, 0.5], [0.5, 1.3], [-0.5, 1.3], [-0.5, 0.5], [-1.3, 0.5]],
  };
  corners[shape].forEach(([right, down], k) => path[k ? "lineTo" : "moveTo"](x + half * right, y + half * down));
  path.closePath();
}
