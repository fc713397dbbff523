/** The page: takes what the server sends, and shows it. */

import { drawPast, Profile } from "./charts.js";
import { Feeder } from "./feeder.js";
import { byId, clock, element, number } from "./format.js";
import { Playback } from "./playback.js";
import { Tables } from "./tables.js";

/** @typedef {import("./types.js").Grid} Grid @typedef {import("./types.js").Moment} Moment */
/** @typedef {import("./types.js").Choice} Choice */

const SILENT_MS = 6000; // after which the server counts as gone
const PAST_MS = 2000; // between two times that the past is asked for
const MOST_OFFERED = 50; // buses and branches whose names begin as typed

/** @type {Choice | null} */ let choice = null;
/** @type {Moment | null} */ let moment = null;
/** @type {Grid} */ let grid;
/** @type {Profile | null} */ let profile = null;
let heardAt = 0;
let pastAt = -Infinity;
const feeder = new Feeder(/** @type {HTMLCanvasElement} */ (byId("drawing")), choose);
const tables = new Tables(choose);

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
  feeder.mark(wanted);
  if (moment) show(moment);
}

/** @param {Grid} found */
async function takeGrid(found) {
  grid = found;
  feeder.setGrid(grid);
  await pause();
  profile = grid.known ? new Profile(grid) : null;
  byId("profile-section").hidden = !grid.known;
  const [low, high] = grid.limits;
  byId("legend").textContent =
    `Buses from dark (${low} p.u.) to bright (${high} p.u.); ringed in red outside of these limits. ` +
    "Dark rings are boundary buses, a red cross a link over which nothing is received. Thick branches are loaded; dashed ones are out of service.";
}

/** Part after part, so that nobody who types or clicks waits for all of them. @param {Moment} found */
async function show(found) {
  moment = found;
  if (!moment.view) return;
  const parts = [showStatus, () => feeder.show(found), () => profile?.show(found), () => tables.show(found), showChoice];
  for (const part of parts) {
    if (moment !== found) return;
    part();
    await pause();
  }
}

/** Lets the browser do something else. @returns {Promise<void>} */
function pause() {
  return new Promise((resolve) => setTimeout(resolve));
}

function showStatus() {
  if (!moment?.view) return;
  const areas = Object.values(moment.view.areas), counts = new Map();
  for (const area of areas) counts.set(area.quality, (counts.get(area.quality) ?? 0) + 1);
  const words = [...counts].map(([quality, n]) => `${n} ${quality}`).join(", ");
  const remarks = [...moment.view.duplicates, ...moment.view.other_versions].join("; ");
  const at = moment.mode === "playback" ? `playback at ${number(moment.at, 6)} s` : `live, ${clock(moment.time)}`;
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
  const { kind, id } = choice;
  ask(`/api/history?kind=${kind}&id=${encodeURIComponent(id)}`).then((past) => {
    if (choice?.kind === kind && choice.id === id) drawPast(kind, past, moment?.mode === "live");
  }).catch(() => byId("past").replaceChildren());
}

function listen() {
  const stream = new EventSource("/api/stream");
  stream.onmessage = async (event) => {
    heardAt = performance.now();
    const found = JSON.parse(event.data);
    if (found.view && !grid.known && Object.keys(found.view.areas).length !== grid.areas.length) await await takeGrid(await ask("/api/grid"));
    show(found);
  };
  setInterval(showStatus, 1000);
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

takeGrid(await ask("/api/grid"));
if (grid.mode === "playback") await new Playback(ask, show).start();
else listen();
