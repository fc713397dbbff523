/**
 * What the API sends; `/api/openapi.json` describes it.
 *
 * @typedef {{id: number[], name: string[], base_kv: (number|null)[], x: number[], y: number[],
 *   distance: (number|null)[], area: string[], areas: string[][]}} Buses
 * @typedef {{id: string[], from_bus: number[], to_bus: number[], in_service: boolean[], area: string[]}} Branches
 * @typedef {{name: string, buses: number[], neighbours: {area: string, bus: number}[]}} Area
 * @typedef {{version: string, known: boolean, title: string, axis: string, limits: [number, number], mode: string, buses: Buses,
 *   branches: Branches, areas: Area[]}} Grid
 * @typedef {{value: number, at: string}} Extreme
 * @typedef {{state: string, quality: string, said_quality: string, scan: number, age_s: number|null, notes: string[],
 *   lowest_vm: Extreme|null, highest_vm: Extreme|null, worst_meter: Extreme|null, messages: number, lost: number,
 *   bytes: number, exchanges: number, removed: string[], critical: string[], meters_off: string[], objective: number,
 *   degrees_of_freedom: number, oldest_reading_s: number, rejected: Record<string, number>, present: boolean,
 *   silent: boolean, estimated: boolean, ages_s: Record<string, number>}} AreaView
 * @typedef {Record<string, (number|string|null)[]>} Columns of buses and branches in the order of the grid, unless they have an `id`
 * @typedef {{from: string, to: string, kind: string, sent: number, arrived: number|null, lost: boolean}} Message
 * @typedef {{number: number, grid_version: string, mode: string, time: number, at: number,
 *   view: {run: string, others: string[], duplicates: string[], other_versions: string[], strangers: number,
 *   areas: Record<string, AreaView>}, buses: Columns, branches: Columns, meters: Columns, meter_counts: Record<string, number>,
 *   links: {from: string, to: string, age_s: number|null, alive: boolean}[],
 *   events: {time: number, area: string, kind: string, text: string}[], messages: Message[], has_messages: boolean}} Moment
 * @typedef {{total: number, rows: Columns}} Rows of `/api/rows`
 * @typedef {{kind: "bus"|"branch"|"meter"|"area", id: string}} Choice
 *
 * What the thread that paints the feeder gets.
 *
 * @typedef {{k: number, x: number, y: number}} Transform pixels = k * pixels + x
 * @typedef {{width: number, height: number, ratio: number, transform: Transform}} View pixels of a picture, and how many of the screen are one
 * @typedef {{colours: Record<string, string>, areas: string[], voltages: string[]}} Palette
 * @typedef {Pick<Moment, "links"|"messages"> & {qualities: Record<string, string>, bus: number[], vm: (number|null)[],
 *   loading: (number|null)[], dead: import("./links.js").DeadLink[]}} PaintedMoment
 * @typedef {{grid: Grid, moment: PaintedMoment|null, choice: Choice|null, view: View, palette: Palette}} Painting
 * @typedef {{canvas?: OffscreenCanvas, changed: Partial<Painting>}} PaintOrder
 */
export {};
