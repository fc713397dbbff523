/** A slider through the moments of a run that is over. */

import { byId, when } from "./format.js";

const STEP_MS = 400; // between two moments while it plays

export class Playback {
  /** @param {(path: string) => Promise<any>} ask @param {(moment: any) => void} show */
  constructor(ask, show) {
    this.ask = ask;
    this.show = show;
    /** @type {number[]} */ this.times = [];
    this.slider = /** @type {HTMLInputElement} */ (byId("moment"));
    this.timer = 0;
    this.wanted = 0;
    this.since = 0;
    this.isAsking = false;
  }

  async start() {
    const frames = await this.ask("/api/frames");
    this.times = frames.times;
    this.since = frames.since;
    byId("playback").hidden = false;
    this.slider.max = String(this.times.length - 1);
    this.slider.addEventListener("input", () => this.go(Number(this.slider.value)));
    byId("first").addEventListener("click", () => this.go(0));
    byId("back").addEventListener("click", () => this.go(this.wanted - 1));
    byId("forward").addEventListener("click", () => this.go(this.wanted + 1));
    byId("last").addEventListener("click", () => this.go(this.times.length - 1));
    byId("play").addEventListener("click", () => (this.timer ? this.pause() : this.play()));
    await this.go(this.times.length - 1);
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
    if (this.wanted === this.times.length - 1) this.wanted = -1;
    byId("play").textContent = "Pause";
    byId("play").setAttribute("aria-pressed", "true");
    const step = async () => {
      await this.go(this.wanted + 1);
      if (this.wanted >= this.times.length - 1) this.pause();
      else if (this.timer) this.timer = window.setTimeout(step, STEP_MS);
    };
    this.timer = window.setTimeout(step, 0);
  }

  pause() {
    clearTimeout(this.timer);
    this.timer = 0;
    byId("play").textContent = "Play";
    byId("play").setAttribute("aria-pressed", "false");
  }
}
