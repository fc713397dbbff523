/** How numbers and words are shown. Everything that comes from a bus is text, never markup. */

const GOOD = "good";

/** @type {Record<string, string>} */ const LABELS = {
  vm_pu: "voltage (p.u.)", va_deg: "angle (°)", sigma_vm_pu: "σ of voltage (p.u.)", sigma_va_deg: "σ of angle (°)",
  p_kw: "injected active power (kW)", q_kvar: "injected reactive power (kvar)",
  p_from_kw: "active power (kW)", q_from_kvar: "reactive power (kvar)", i_from_a: "current (A)", loss_kw: "loss (kW)",
  loading_percent: "loading (%)", age_s: "age (s)", sigma: "σ of the reading", residual_in_sigmas: "residual in σ of the reading",
};
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

/** @param {string} quality @returns {string} class of its colour */
export function qualityClass(quality) {
  return quality === GOOD ? "good" : quality === "degraded" ? "degraded" : "bad";
}

/** @param {number | null | undefined} value @param {number} digits significant ones @returns {string} */
export function number(value, digits = 5) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  return Math.abs(value) >= 1e9 ? value.toExponential(2) : String(Number(value.toPrecision(digits)));
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
  return since > 0 ? clock(since + at) : `${number(at, 6)} s`;
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
