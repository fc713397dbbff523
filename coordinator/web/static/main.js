/** The page: takes what the server sends, and shows it. */

import { Past, Profile } from "./charts.js";
import { Feeder } from "./feeder.js";
import { byId, clock, element, nextPicture, number, when } from "./format.js";
import { Playback } from "./playback.js";
import { Tables } from "./tables.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice */

const SILENT_MS = 6000; // after which the server counts as gone
const PAST_MS = 2000; // between two times that the past is asked for
const AGAIN_MS = 1000; // until the server is asked once more when it has refused
const MOST_OFFERED = 50; // buses and branches whose names begin as typed

/** @type {Choice | null} */ let choice = null;
/** @type {Moment | null} */ let moment = null; // the one that is shown
/** @type {Moment | null} */ let next = null; // the one to show after it
/** @type {Grid} */ let grid;
/** @type {Profile | null} */ let profile = null;
let isShowing = false;
let heardAt = 0;
let pastAt = -Infinity;
const feeder = new Feeder(/** @type {HTMLCanvasElement} */ (byId("drawing")), /** @type {HTMLCanvasElement} */ (byId("print")), choose);
const tables = new Tables(choose);
const past = new Past();

/** @param {string} path @returns {Promise<any>} */
async function ask(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
  return answer.json();
}

/** @param {Choice} wanted */
function choose(wanted) {
  choice = tables.choice = wanted;
  pastAt = -Infinity;
  past.clear();
  feeder.mark(wanted);
  showChoice();
  const shown = next ?? moment;
  if (shown) take(shown);
}

/** @param {Grid} found */
async function takeGrid(found) {
  grid = found;
  feeder.setGrid(grid);
  await nextPicture();
  profile?.destroy();
  profile = grid.known ? new Profile(grid) : null;
  byId("profile-section").hidden = !grid.known;
  const [low, high] = grid.limits;
  byId("legend").textContent =
    `Buses from dark (${low} p.u.) to bright (${high} p.u.); ringed in red outside of these limits. ` +
    "Dark rings are boundary buses, a red cross a link over which nothing is received. Thick branches are loaded; dashed ones are out of service.";
}

/**
 * Show `found`, or what is newer when its turn comes: one moment is shown after the other, each of them whole, and a
 * grid that has changed is asked for first.
 * @param {Moment} found
 */
async function take(found) {
  next = found;
  if (isShowing) return;
  isShowing = true;
  try {
    while (next) {
      const now = next;
      next = null;
      if (!now.view) continue;
      if (now.grid_version !== grid.version) await takeGrid(await ask("/api/grid").catch(() => grid));
      if (now.grid_version === grid.version) await show(now); // else the next one is on its way
    }
  } finally {
    isShowing = false;
  }
}

/** Part after part, so that nobody who types or clicks waits for all of them. @param {Moment} found */
async function show(found) {
  moment = found;
  for (const part of [showStatus, () => feeder.show(found), showChoice, () => profile?.show(found), () => tables.show(found)]) {
    await part();
    await nextPicture();
  }
  document.body.dataset.moment = String(found.number); // all of it is shown
}

function showStatus() {
  if (!moment?.view) return;
  const areas = Object.values(moment.view.areas), counts = new Map();
  for (const area of areas) counts.set(area.quality, (counts.get(area.quality) ?? 0) + 1);
  const words = [...counts].map(([quality, n]) => `${n} ${quality}`).join(", ");
  const strangers = moment.view.strangers ? [`${moment.view.strangers} more that are announced as areas are not shown`] : [];
  const remarks = [...strangers, ...moment.view.duplicates, ...moment.view.other_versions].join("; ");
  const at = moment.mode === "playback" ? `playback at ${when(moment, moment.at)}` : `live, ${clock(moment.time)}`;
  const lost = moment.mode === "live" && performance.now() - heardAt > SILENT_MS;
  const text = lost ? `The server has sent nothing since ${clock(moment.time)}.` : `${at}: ${areas.length} areas: ${words || "nobody is there"}. ${remarks}`;
  byId("title").textContent = `${grid.title === moment.view.run ? "" : `${grid.title}: `}run ${moment.view.run}`;
  const status = byId("status");
  status.className = lost ? "lost" : "";
  if (status.textContent !== text) status.textContent = text;
  feeder.canvas.setAttribute("aria-label", `The feeder with ${grid.buses.id.length} buses; ${areas.length} areas: ${words}. The tables below have the same.`);
}

/** @returns {[string, string][]} what is known of the choice */
function describeChoice() {
  if (!moment || !choice) return [];
  const { kind, id } = choice;
  if (kind === "area") {
    const area = moment.view.areas[id];
    if (!area) return [["area", id], ["quality", "not there"]];
    return [
      ["area", id], ["quality", area.quality], ["why", area.notes.join("; ") || "nothing to remark"], ["it says", area.said_quality],
      ["J", `${number(area.objective, 4)} with ${area.degrees_of_freedom} degrees of freedom`], ["oldest reading", `${number(area.oldest_reading_s, 3)} s`],
      ["removed", area.removed.join(", ") || "none"], ["off", area.meters_off.join(", ") || "none"],
      ["rejected", Object.entries(area.rejected).map(([why, n]) => `${why} ${n}`).join(", ") || "nothing"], ["bytes", String(area.bytes)],
    ];
  }
  const [columns, key] = kind === "bus" ? [moment.buses, "id"] : kind === "branch" ? [moment.branches, ""] : [moment.meters, "meter"];
  const names = key ? (columns[key] ?? []).map(String) : grid.branches.id, row = names.indexOf(id);
  const facts = row < 0 ? [] : Object.entries(columns).filter(([name]) => name !== key)
    .map(([name, column]) => /** @type {[string, string]} */ ([name.replaceAll("_", " "), typeof column[row] === "string" ? String(column[row]) : number(/** @type {number} */ (column[row]), 6)]));
  const place = kind === "bus" ? grid.buses.id.indexOf(Number(id)) : -1;
  const more = place < 0 ? [] : [["name", grid.buses.name[place] || "-"], ["base kV", number(grid.buses.base_kv[place])], ["areas", grid.buses.areas[place].join(", ")]];
  return [[kind, id], .../** @type {[string, string][]} */ (more), ...facts];
}

function showChoice() {
  byId("nothing").hidden = choice !== null;
  byId("facts").replaceChildren(...describeChoice().flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
  if (!choice || performance.now() - pastAt < PAST_MS) return;
  pastAt = performance.now();
  const { kind, id } = choice, ofDay = moment?.mode === "live";
  ask(`/api/history?kind=${kind}&id=${encodeURIComponent(id)}`).then((found) => {
    if (choice?.kind === kind && choice.id === id) past.show(kind, id, found, ofDay);
  }).catch(() => past.clear());
}

/** Paper is light, whatever the screen is. @param {boolean} isPrinting */
function showPrint(isPrinting) {
  document.documentElement.classList.toggle("printing", isPrinting);
  if (isPrinting) feeder.paintPrint();
  profile?.repaint();
  past.repaint();
}

function listen() {
  const stream = new EventSource("/api/stream");
  stream.onmessage = (event) => {
    heardAt = performance.now();
    take(JSON.parse(event.data));
  };
  stream.onerror = () => {
    if (stream.readyState !== EventSource.CLOSED) return; // the browser tries again by itself
    stream.close();
    setTimeout(listen, AGAIN_MS);
  };
}

byId("find").addEventListener("submit", (event) => {
  event.preventDefault();
  const id = /** @type {HTMLInputElement} */ (byId("what")).value.trim();
  if (grid.buses.id.includes(Number(id))) choose({ kind: "bus", id });
  else if (grid.branches.id.includes(id)) choose({ kind: "branch", id });
});
byId("what").addEventListener("input", () => {
  const typed = /** @type {HTMLInputElement} */ (byId("what")).value.trim();
  const found = [...grid.buses.id.map(String), ...grid.branches.id].filter((name) => name.startsWith(typed));
  byId("things").replaceChildren(...found.slice(0, MOST_OFFERED).map((name) => {
    const option = document.createElement("option");
    option.value = name;
    return option;
  }));
});
byId("whole").addEventListener("click", () => feeder.reset());
window.addEventListener("beforeprint", () => showPrint(true));
window.addEventListener("afterprint", () => showPrint(false));

grid = await ask("/api/grid");
await takeGrid(grid);
if (grid.mode === "playback") {
  await new Playback(ask, take).start();
} else {
  listen();
  setInterval(showStatus, 1000);
}
