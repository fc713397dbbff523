/** A slider through the moments of a run; while it is still computed the slider grows. */

import { byId, when } from "./format.js";

const STEP_MS = 400; // between two moments while it plays
const GROW_MS = 1000; // between two questions whether there are more moments

export class Playback {
  /** @param {(path: string) => Promise<any>} ask @param {(moment: any) => void} show */
  constructor(ask, show) {
    this.ask = ask;
    this.show = show;
    /** @type {number[]} */ this.times = [];
    this.slider = /** @type {HTMLInputElement} */ (byId("moment"));
    this.timer = 0;
    this.turn = 0; // which time it plays
    this.wanted = 0;
    this.since = 0;
    this.isAsking = false;
    this.follows = true; // the newest moment, until somebody steers
  }

  async start() {
    byId("playback").hidden = false;
    const steer = (/** @type {() => number} */ frame) => () => {
      this.follows = false;
      this.go(frame());
    };
    this.slider.addEventListener("input", steer(() => Number(this.slider.value)));
    byId("first").addEventListener("click", steer(() => 0));
    byId("back").addEventListener("click", steer(() => this.wanted - 1));
    byId("forward").addEventListener("click", steer(() => this.wanted + 1));
    byId("last").addEventListener("click", steer(() => this.times.length - 1));
    byId("play").addEventListener("click", () => (this.timer ? this.pause() : this.play()));
    await this.grow();
  }

  /** Take what can be played by now, and ask again later unless that is all. */
  async grow() {
    let isComplete = false;
    try {
      const frames = await this.ask("/api/frames");
      ({ times: this.times, since: this.since, complete: isComplete } = frames);
      this.slider.max = String(this.times.length - 1);
      byId("remarks").hidden = !frames.remarks.length;
      byId("remarks").textContent = `Note: ${frames.remarks.join("; ")}.`;
      if (this.follows) await this.go(this.times.length - 1);
    } catch {
      byId("clock").textContent = "the server does not answer";
    }
    if (isComplete) document.body.dataset.complete = "true";
    else setTimeout(() => this.grow(), GROW_MS);
  }

  /** @param {number} frame */
  async go(frame) {
    this.wanted = Math.max(0, Math.min(this.times.length - 1, frame));
    const at = this.times[this.wanted], text = when({ mode: "playback", time: this.since + at, at }, at);
    this.slider.value = String(this.wanted);
    this.slider.setAttribute("aria-valuetext", text);
    byId("clock").textContent = text;
    if (this.isAsking) return; // the one that is wanted then is asked for after it
    this.isAsking = true;
    try {
      for (let asked = -1; asked !== this.wanted;) {
        asked = this.wanted;
        this.show(await this.ask(`/api/frame/${asked}`));
      }
    } catch {
      byId("clock").textContent = "the server does not answer";
    } finally {
      this.isAsking = false;
    }
  }

  play() {
    this.follows = false;
    if (this.wanted === this.times.length - 1) this.wanted = -1;
    byId("play").textContent = "Pause";
    byId("play").setAttribute("aria-pressed", "true");
    const turn = ++this.turn;
    const step = async () => {
      await this.go(this.wanted + 1);
      if (turn !== this.turn) return; // paused meanwhile, and perhaps begun anew
      if (this.wanted >= this.times.length - 1) this.pause();
      else this.timer = window.setTimeout(step, STEP_MS);
    };
    this.timer = window.setTimeout(step, 0);
  }

  pause() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.turn += 1;
    byId("play").textContent = "Play";
    byId("play").setAttribute("aria-pressed", "false");
  }
}
