/**
 * What the API sends; `/api/openapi.json` describes it.
 *
 * @typedef {{id: number[], phase: string[], name: string[], base_kv: (number|null)[], x: number[], y: number[],
 *   distance: (number|null)[], area: string[], areas: string[][]}} Buses whose `phase` is abc, or the phases that each has
 * @typedef {{id: string[], from_bus: number[], to_bus: number[], in_service: boolean[], area: string[]}} Branches
 * @typedef {{name: string, buses: number[], neighbours: {area: string, bus: number}[]}} Area
 * @typedef {{lowest_vm_pu: number, highest_vm_pu: number, most_loading_percent: number, most_residual: number, most_unbalance_percent: number}} Limits
 * @typedef {{version: string, known: boolean, title: string, axis: string, operating_limits: Limits, mode: string, is_map: boolean, buses: Buses,
 *   branches: Branches, areas: Area[], nodes?: {bus: number[], phase: string[]}, conductors?: {branch: string[], phase: string[]}}} Grid `nodes` of one with phases, `conductors` of a known one
 * @typedef {{value: number, at: string}} Extreme
 * @typedef {{state: string, quality: string, said_quality: string, scan: number, age_s: number|null, notes: string[],
 *   lowest_vm: Extreme|null, highest_vm: Extreme|null, worst_meter: Extreme|null, messages: number, lost: number,
 *   bytes: number, exchanges: number, removed: string[], critical: string[], meters_off: string[], objective: number,
 *   degrees_of_freedom: number, oldest_reading_s: number, rejected: Record<string, number>, present: boolean,
 *   fresh: boolean, value_age_s: number|null, silent: boolean, estimated: boolean, ages_s: Record<string, number>,
 *   switches?: Record<string, string>}} AreaView `switches`: switch -> "open" or "closed"
 * @typedef {{known: number, total: number, outside: number, worst: Extreme[], lowest: Extreme|null, highest: Extreme|null}} Spread
 * @typedef {{known: number, total: number, p_kw: number|null, q_kvar: number|null}} Total
 * @typedef {Record<"voltage"|"unbalance"|"loading"|"current"|"residual", Spread> & Record<"head"|"loss"|"load"|"generation", Total> & {has_phases: boolean}} Summary of fresh values; `has_phases`: of nodes and conductors
 * @typedef {{kind: string, severity: string, scope: string, remark: string, mark: string, what: string, since: number|null, action: string, text: string, areas: string[], buses: number[],
 *   branches: string[], meters: string[], effects: string[]}} Cause
 * @typedef {{time: number, area: string, kind: string, text: string}} Event
 * @typedef {Record<string, (number|string|boolean|null)[]>} Columns of nodes and conductors in the order of the grid, unless they have an `id`
 * @typedef {{from: string, to: string, kind: string, sent: number, arrived: number|null, lost: boolean}} Message
 * @typedef {{number: number, grid_version: string, mode: string, time: number, at: number,
 *   view: {run: string, others: string[], duplicates: string[], other_versions: string[], strangers: number,
 *   areas: Record<string, AreaView>}, buses: Columns, worst_nodes?: number[], branches: Columns, meters: Columns, meter_counts: Record<string, number>,
 *   links: {from: string, to: string, age_s: number|null, alive: boolean}[],
 *   causes: Cause[], summary: Summary, scan_s: number|null, events: Event[], messages: Message[], has_messages: boolean}} Moment
 * @typedef {{total: number, rows: Columns}} Rows of `/api/rows`
 * @typedef {{kind: "bus"|"branch"|"meter"|"area", id: string}} Choice
 *
 * What the thread that paints the feeder gets.
 *
 * @typedef {{k: number, x: number, y: number}} Transform pixels = k * pixels + x
 * @typedef {{width: number, height: number, ratio: number, transform: Transform}} View pixels of a picture, and how many of the screen are one
 * @typedef {{colours: Record<string, string>, areas: string[], voltages: string[]}} Palette
 * @typedef {Pick<Moment, "links"|"messages"> & {qualities: Record<string, string>, worst: import("./phases.js").Chosen[],
 *   loading: import("./phases.js").Chosen[], freshBranches: boolean[], switches: Record<string, string>, dead: import("./links.js").DeadLink[], cause: Cause|null}} PaintedMoment
 * @typedef {{grid: Grid, moment: PaintedMoment|null, choice: Choice|null, view: View, palette: Palette}} Painting
 * @typedef {{canvas?: OffscreenCanvas, changed: Partial<Painting>}} PaintOrder
 */
export {};
