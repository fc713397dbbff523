/** Areas, meters and messages as tables. */

import { csvOfColumns, keep } from "./csv.js";
import { byId, entryOf, fixed, nextPicture, number, qualityClass, unitOf, when } from "./format.js";
import { countReceived } from "./links.js";
import { Rows } from "./rows.js";
import { ageOf, FINE } from "./selected.js";

/** @typedef {import("./types.js").AreaView} AreaView @typedef {import("./types.js").Moment} Moment @typedef {import("./types.js").Choice} Choice */

const MOST_METERS = 100;
const MOST_AREAS = 200;
/** @type {Record<string, string>} */ const CSV_OF = { meter: "meters-csv", bus: "buses-csv", branch: "branches-csv" }; // kind of row -> its button
const MOST_ROWS = 1000; // of one request

/**
 * Where there are very many: those that are not good, then good ones, then those that have never published.
 * @param {[string, AreaView][]} areas @returns {[string, AreaView][]}
 */
function chooseAreas(areas) {
  if (areas.length <= MOST_AREAS) return areas;
  const rank = (/** @type {AreaView} */ area) => (area.age_s === null ? 2 : area.quality === "good" ? 1 : 0);
  return [...areas].sort(([, one], [, other]) => rank(one) - rank(other)).slice(0, MOST_AREAS);
}

export class Tables {
  /** @param {(choice: Choice) => void} choose @param {(path: string) => Promise<any>} ask @param {() => void} showAgain */
  constructor(choose, ask, showAgain) {
    this.choose = choose;
    this.ask = ask;
    this.first = 0; // of the meters that are shown, the worst being 0
    for (const [id, step] of /** @type {[string, number][]} */ ([["meters-back", -MOST_METERS], ["meters-on", MOST_METERS]])) {
      byId(id).addEventListener("click", () => {
        this.first = Math.max(0, this.first + step);
        showAgain();
      });
    }
    /** @type {Choice | null} */ this.choice = null;
    /** @type {Moment | null} */ this.moment = null;
    this.areas = new Rows("areas", "What each area says of its estimate, and why.", [
      { title: "Area" }, { title: "Quality" }, { title: "Why" }, { title: "Receives from" }, { title: "Voltage (p.u.)" },
      { title: "Worst normalised residual" }, { title: "Age (s)", number: true }, { title: "Readings of" },
      { title: "Exchanges", number: true }, { title: "Messages", number: true }, { title: "Lost", number: true },
    ]);
    this.hasPhases = false; // of the meters
    this.meters = this.makeMeters();
    this.messages = new Rows("messages", "Messages on their way at this moment.", [
      { title: "From" }, { title: "To" }, { title: "Kind" }, { title: "Sent (s)", number: true }, { title: "What became of it" },
    ]);
    for (const kind of ["meter", "bus", "branch"]) byId(CSV_OF[kind]).addEventListener("click", () => this.keepAll(kind));
    byId("areas-csv").addEventListener("click", () => keep("areas.csv", this.areas.csv()));
    byId("messages-csv").addEventListener("click", () => keep("messages.csv", this.messages.csv()));
  }

  makeMeters() {
    return new Rows("meters", "Readings and estimates, the farthest off first.", [
      { title: "Meter" }, { title: "Status" }, { title: "Area" }, ...(this.hasPhases ? [{ title: "Phase" }] : []), { title: "Reading", number: true },
      { title: "Estimate", number: true }, { title: "Unit" }, { title: "Quality" }, { title: "Normalised residual", number: true },
      { title: "Age (s)", number: true },
    ]);
  }

  /** @param {Moment} moment */
  async show(moment) {
    this.moment = moment;
    const is = (/** @type {string} */ kind, /** @type {string} */ id) => this.choice?.kind === kind && this.choice.id === id;
    const areas = Object.entries(moment.view.areas), received = countReceived(moment.links);
    await this.areas.show(chooseAreas(areas).map(([name, area]) => ({
      cells: [
        name, area.quality, area.notes.join("; "), received.get(name) ?? "-",
        area.lowest_vm && area.highest_vm ? `${fixed(area.lowest_vm.value, "vm_pu")} to ${fixed(area.highest_vm.value, "vm_pu")}` : "-",
        area.worst_meter ? `${area.worst_meter.at} ${fixed(area.worst_meter.value, "normalised_residual")}` : "-",
        fixed(area.value_age_s, "age_s"), area.value_age_s === null ? "-" : when(moment, moment.at - area.value_age_s), String(area.exchanges), String(area.messages), String(area.lost),
      ],
      className: qualityClass(area.quality),
      old: !area.fresh,
      choose: () => this.choose({ kind: "area", id: name }),
      chosen: is("area", name),
    })));
    await nextPicture();
    await this.showMeters(moment, is);
    await this.messages.show(moment.messages.map((m) => ({
      cells: [m.from, m.to, m.kind, number(m.sent, 6), m.lost ? "lost" : m.arrived === null ? "on its way" : `arrived at ${number(m.arrived, 6)} s`],
    })));
    byId("messages-section").hidden = !moment.has_messages;
  }

  /** @param {Moment} moment @param {(kind: string, id: string) => boolean} is */
  async showMeters(moment, is) {
    const counts = moment.meter_counts, count = Object.values(counts).reduce((sum, n) => sum + n, 0);
    if (this.first >= count) this.first = 0;
    const meters = await this.findMeters(moment), shown = meters.meter?.length ?? 0, hasPhases = meters.phase !== undefined;
    if (shown && hasPhases !== this.hasPhases) {
      this.hasPhases = hasPhases;
      this.meters = this.makeMeters();
    }
    const some = shown < count ? `; ${this.first + 1} to ${this.first + shown} are shown` : "";
    const rest = Object.entries(counts).filter(([status]) => status !== "used" && status !== "critical").map(([status, n]) => `, ${n} ${status}`);
    byId("meters-note").textContent = count ? `${count} meters${rest.join("")}${some}.` : "No readings are known.";
    byId("meters-pages").hidden = count <= MOST_METERS;
    /** @type {HTMLButtonElement} */ (byId("meters-back")).disabled = this.first === 0;
    /** @type {HTMLButtonElement} */ (byId("meters-on")).disabled = this.first + shown >= count;
    await this.meters.show((meters.meter ?? []).map((meter, k) => {
      const unit = String(meters.unit?.[k] ?? ""), area = entryOf(moment.view.areas, String(meters.area[k]));
      const isOld = meters.fresh?.[k] === false, quality = isOld && area ? `${area.quality}, ${ageOf(true, area.value_age_s)}` : area?.quality ?? "-";
      return {
        cells: [
          String(meter), String(meters.status[k]), String(meters.area[k]), ...(this.hasPhases ? [String(meters.phase?.[k] ?? "-")] : []), fixed(meters.reading[k], unit), fixed(meters.estimate[k], unit),
          unitOf(meters.unit?.[k]), quality, fixed(meters.normalised_residual?.[k], "normalised_residual"), fixed(meters.age_s[k], "age_s"),
        ],
        className: FINE.includes(String(meters.status[k])) ? "" : "bad",
        choose: () => this.choose({ kind: "meter", id: String(meter) }),
        chosen: is("meter", String(meter)),
        old: isOld,
      };
    }));
  }

  /** All rows of a kind, with all columns, as a file. @param {string} kind */
  async keepAll(kind) {
    if (!this.moment) return;
    const frame = this.moment.mode === "playback" ? `&frame=${this.moment.number}` : "";
    /** @type {import("./types.js").Columns} */ let all = {};
    for (let first = 0, total = 1; first < total; first += MOST_ROWS) {
      const found = await this.ask(`/api/rows?kind=${kind}&first=${first}&count=${MOST_ROWS}${frame}`).catch(() => null);
      if (!found) return;
      total = found.total;
      all = first ? Object.fromEntries(Object.entries(all).map(([name, column]) => [name, [...column, ...(found.rows[name] ?? [])]])) : found.rows;
    }
    keep(`${CSV_OF[kind].replace("-csv", "")}.csv`, csvOfColumns(all));
  }

  /** The worst come with the moment, the others are asked for. @param {Moment} moment @returns {Promise<import("./types.js").Columns>} */
  async findMeters(moment) {
    if (!this.first) return moment.meters;
    const frame = moment.mode === "playback" ? `&frame=${moment.number}` : "";
    const found = await this.ask(`/api/rows?kind=meter&first=${this.first}&count=${MOST_METERS}${frame}`).catch(() => null);
    return found ? found.rows : moment.meters;
  }
}
