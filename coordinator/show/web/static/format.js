/** How numbers and words are shown. Everything that comes from a bus is text, never markup. */

const GOOD = "good";

/** @type {Record<string, string>} */ const LABELS = {
  vm_pu: "voltage (p.u.)", va_deg: "angle (°)", sigma_vm_pu: "σ of voltage (p.u.)", sigma_va_deg: "σ of angle (°)",
  vm_kv: "voltage to ground (kV)", unbalance_percent: "unbalance (%)", neutral_a: "neutral current (A)", i_to_a: "current at the to end (A)",
  p_kw: "injected active power (kW)", q_kvar: "injected reactive power (kvar)",
  p_from_kw: "active power (kW)", q_from_kvar: "reactive power (kvar)", i_from_a: "current (A)", loss_kw: "loss (kW)",
  loading_percent: "loading (%)", age_s: "age (s)", sigma: "σ of the reading", residual_in_sigmas: "residual in σ of the reading",
  lowest_vm_pu: "lowest voltage (p.u.)", highest_vm_pu: "highest voltage (p.u.)", lost: "lost messages",
};
/** @type {Record<string, number>} */ const DECIMALS = { // after the point: a column, or a unit of a reading
  vm_pu: 4, lowest_vm_pu: 4, highest_vm_pu: 4, va_deg: 3, sigma_vm_pu: 5, sigma_va_deg: 4, p_kw: 1, q_kvar: 1, p_from_kw: 1, q_from_kvar: 1,
  i_from_a: 1, i_to_a: 1, neutral_a: 1, vm_kv: 4, unbalance_percent: 2, p_to_kw: 1, q_to_kvar: 1, loss_kw: 2, loading_percent: 1, normalised_residual: 2, residual_in_sigmas: 2, age_s: 1,
  pu: 4, deg: 3, kw: 2, kvar: 2, a: 2,
};
const OTHER_DECIMALS = 5; // of a reading in p.u. or rad
/** @type {Record<string, string>} */ const UNITS = { pu: "p.u.", deg: "°", kw: "kW", kvar: "kvar", a: "A" };

/** @param {string} column of the API @returns {string} what it is called on the page */
export function labelOf(column) {
  return LABELS[column] ?? column.replaceAll("_", " ");
}

/** @param {unknown} unit as the API has it @returns {string} as people write it; without one a reading is in p.u. or rad */
export function unitOf(unit) {
  return unit === undefined ? "p.u., rad" : UNITS[String(unit)] ?? String(unit);
}

/**
 * What is said under a name that strangers choose: "constructor" is not what every object has.
 * @template T @param {Record<string, T>} said @param {string} name @returns {T | undefined}
 */
export function entryOf(said, name) {
  return Object.hasOwn(said, name) ? said[name] : undefined;
}

/** @param {string} quality @returns {"good"|"degraded"|"bad"} class of its colour: amber while its numbers are of now */
export function qualityClass(quality) {
  return quality === GOOD ? "good" : ["degraded", "relative-angle"].includes(quality) ? "degraded" : "bad";
}

/** @param {number | null | undefined} value @param {number} digits significant ones @returns {string} */
export function number(value, digits = 5) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  return Math.abs(value) >= 1e9 ? value.toExponential(2) : String(Number(value.toPrecision(digits)));
}

/**
 * A number of a column, or of a unit, with the digits that all numbers there have.
 * @param {unknown} value @param {string} of @returns {string}
 */
export function fixed(value, of) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "-";
  if (Math.abs(value) >= 1e9) return value.toExponential(2);
  const text = value.toFixed(entryOf(DECIMALS, of) ?? OTHER_DECIMALS);
  return Number(text) === 0 ? text.replace("-", "") : text;
}

/** @param {string} text @param {number} most characters @returns {string} */
export function shorten(text, most) {
  return text.length > most ? `${text.slice(0, most - 1)}…` : text;
}

/** @param {number} seconds since 1970 @returns {string} local time of day, 0 to 24 h as in a control room */
export function clock(seconds) {
  return new Date(seconds * 1000).toLocaleTimeString([], { hourCycle: "h23" });
}

/**
 * A time of a run in words: of a simulated one in seconds, else as the time of day.
 * @param {{mode: string, time: number, at: number}} moment `time` is 1970 or more where `at` counts from elsewhere
 * @param {number} at as in `moment.at`
 * @returns {string}
 */
export function when(moment, at) {
  if (moment.mode === "live") return clock(at);
  const since = moment.time - moment.at;
  return since > 0 ? clock(since + at) : `${Number(at.toFixed(3))} s`;
}

/**
 * @param {string} tag @param {string} [text] @param {string} [className]
 * @returns {HTMLElement}
 */
export function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

/** @param {string} id @returns {HTMLElement} */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element ${id}`);
  return found;
}

/** @param {string} name of a custom property of the style sheet @returns {string} */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/**
 * When the next picture is on the screen: what is done before and after it are laid out apart from each other, and who
 * types or clicks meanwhile is served between the two. Nothing goes on while nobody sees the page.
 * @returns {Promise<void>}
 */
export function nextPicture() {
  return new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
}
