// The page of a run: what it tells twice a second, and what may be asked of it. Closing the page changes nothing.

import { asked, keyOf } from "./access.js";

const POLL_MS = 500;
const LATE_MS = 3000;
const GONE_AFTER = 4;
const WINDOW_PX = 48;
const COLOURS = { left: "#1f6fb2", right: "#c2410c", up: "#2f8f4e", down: "#8f4bb0" };
const WORDS = { running: "the run goes on", paused: "PAUSED: laser off, nothing moves until resume or stop", ended: "the run has ended" };
const NOISY = 2;
const SVG = "http://www.w3.org/2000/svg";
const by = (id) => document.getElementById(id);

function element(name, attributes, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

function time(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** Fills a table, or an element with one; a cell is text, or text and its class. */
function rows(table, heads, lines) {
  const made = document.createElement("table");
  if (heads.length) {
    const head = made.createTHead().insertRow();
    for (const text of heads) {
      const cell = document.createElement("th");
      cell.textContent = text;
      head.append(cell);
    }
  }
  const body = made.createTBody();
  for (const line of lines) {
    const row = body.insertRow();
    for (const [text, kind] of line.map((cell) => [cell].flat())) {
      const cell = row.insertCell();
      cell.textContent = text;
      if (kind) cell.className = kind;
    }
  }
  table.replaceChildren(...(table.tagName === "TABLE" ? made.childNodes : [made]));
}

class LivePage {
  constructor(key) {
    this.key = key;
    this.shown = { requests: "", estimates: 0, look: null };
    for (const button of document.querySelectorAll("#buttons button")) {
      button.addEventListener("click", () => this.ask(button.dataset.what));
    }
    for (const change of ["(prefers-color-scheme: dark)", "(max-width: 700px)"]) {
      matchMedia(change).addEventListener("change", () => this.drawHistory(this.told));
    }
  }

  /** Put a request; what became of it is told with the next snapshots. */
  async ask(what) {
    try {
      await asked("/ask", this.key, { method: "POST", body: JSON.stringify({ what }), signal: AbortSignal.timeout(LATE_MS) });
      await this.refresh();
    } catch (error) {
      by("rights").textContent = `not sent: ${error.message}`;
    }
  }

  async refresh() {
    this.told = await (await asked("/live", this.key, { signal: AbortSignal.timeout(LATE_MS) })).json();
    await this.show(this.told);
  }

  async watch() {
    let missed = 0;
    while (document.body.dataset.state !== "ended") {
      try {
        await this.refresh();
        missed = 0;
        document.body.dataset.state = this.told.state;
      } catch (error) {
        missed += 1;
        if (missed >= GONE_AFTER) return this.gone();
      }
      await new Promise((go) => setTimeout(go, POLL_MS));
    }
  }

  gone() {
    document.body.dataset.state = "gone";
    by("notes").textContent = "no answer any more: this page no longer shows the run. The terminal knows; Ctrl-C there stops it";
    by("notes").classList.add("refused");
    for (const button of document.querySelectorAll("#buttons button")) button.disabled = true;
  }

  async show(told) {
    by("name").textContent = told.name || "run";
    document.title = `${told.state}: ${told.name} - tvsbayes acquire`;
    const reason = told.state === "ended" ? `: ${told.reason}` : "";
    by("notes").textContent = `${told.simulated ? "simulated; " : ""}${WORDS[told.state]}${reason}`;
    this.allow(told);
    by("fault").hidden = told.fault === null;
    if (told.fault) {
      const { message, remedy } = told.fault;
      by("fault").textContent = remedy && !message.includes(remedy) ? `${message}; ${remedy}` : message;
    }
    this.showRun(told);
    this.showRequests(told.requests);
    this.showEstimates(told);
    const remarks = [...told.warnings.map((text) => `warning: ${text}`), ...told.remarks.toReversed()];
    by("remarks").replaceChildren(...(remarks.length ? remarks : ["none"]).map((text) => {
      const item = document.createElement("li");
      item.textContent = text;
      return item;
    }));
    await this.showLook(told);
  }

  /** Which buttons make sense now, and whether this browser may press them. */
  allow({ state, controls, requests }) {
    const waits = (what) => requests.some((request) => request.what === what && request.state === "requested");
    const sensible = { pause: state === "running", resume: state === "paused", stop: state !== "ended", "laser off": state !== "ended" };
    for (const button of document.querySelectorAll("#buttons button")) {
      const what = button.dataset.what;
      button.disabled = !controls || !sensible[what] || waits(what);
    }
    by("rights").textContent = controls ? "this browser controls" : "this browser only watches: the first one that opened the link controls";
    document.body.dataset.controls = controls;
  }

  showRun({ progress, coming, device, state }) {
    if (!progress) return rows(by("facts"), [], [["before the first step"]]);
    by("bar").max = progress.steps;
    by("bar").value = state === "ended" ? Math.max(progress.step, by("bar").value) : progress.step;
    const light = device ? `${device.status} at pan ${device.pan_steps}, tilt ${device.tilt_steps}, laser ${device.laser_on ? "ON" : "off"}` : "not asked yet";
    rows(by("facts"), [], [
      ["now", state === "paused" ? `paused; begun last: ${progress.doing}` : state === "ended" ? "ended" : progress.doing],
      ["then", state === "ended" ? "" : coming.join(", ") || "the end of the plan"],
      ["step", `${progress.step} of ${progress.steps}`],
      ["look", `${progress.looks} of ${progress.looks_total}; ${progress.refused} refused, ${progress.retries} repeated`],
      ["time left", state === "ended" ? "" : `about ${time(progress.seconds_left)} by [costs] of the rig file`],
      ["device", light],
    ].filter(([, text]) => text));
  }

  showRequests(requests) {
    const text = JSON.stringify(requests);
    if (text === this.shown.requests) return;
    this.shown.requests = text;
    if (!requests.length) return rows(by("requests"), [], [["nothing yet"]]);
    rows(by("requests"), ["", "asked for", "", "after", "answer"], requests.toReversed().map((request) => [
      String(request.number), request.what, [request.state, request.state],
      request.waited_s === null ? "" : `${request.waited_s.toFixed(2)} s`, request.answer,
    ]));
  }

  showEstimates(told) {
    const { estimates, aim, temperature } = told;
    const target = aim.target_u_deg_per_step;
    const wanted = target === null ? "" : `; wanted: u at most ${target.toPrecision(2)} in ${aim.directions.join(", ")}`;
    if (!estimates.length) {
      by("estimate-remark").textContent = `no estimate yet${wanted}`;
      return;
    }
    const last = estimates.at(-1);
    const heat = temperature?.rms ?? null;
    const drift = heat === null ? "" : `. Temperature ${heat.toFixed(1)}: how far the newest looks moved it, in sd of how far they should; `
      + (heat > NOISY ? "well above 1: drift, lost steps, something knocked?" : "about 1 is calm");
    by("estimate-remark").textContent = `of ${last.looks} looks${wanted}${drift}`;
    if (estimates.length === this.shown.estimates) return;
    this.shown.estimates = estimates.length;
    const heads = ["direction", "deg/step", "u", "target", "moved, sd"];
    rows(by("estimates"), heads, Object.entries(last.deg_per_step).map(([name, value]) => {
      const u = last.u_deg_per_step[name];
      const moved = temperature?.moved[name] ?? null;
      const met = target === null || !aim.directions.includes(name) ? "" : u <= target ? "met" : `u / target ${(u / target).toFixed(1)}`;
      return [name, value.toFixed(6), u.toExponential(1), met, [moved === null ? "" : moved.toFixed(1), Math.abs(moved) > 3 ? "hot" : ""]];
    }));
    this.drawHistory(told);
  }

  /** Every estimate with its 95 % bars over the looks it was made of. */
  drawHistory(told) {
    if (!told?.estimates.length) return;
    by("history").hidden = false;
    const style = getComputedStyle(document.documentElement);
    const [ink, line] = ["--ink", "--line"].map((name) => style.getPropertyValue(name).trim());
    const names = Object.keys(told.estimates.at(-1).deg_per_step);
    const axes = Object.fromEntries(names.flatMap((name, k) => [
      [`yaxis${k ? k + 1 : ""}`, { title: { text: name }, gridcolor: line, zeroline: false, tickformat: ".4f", automargin: true }],
      [`xaxis${k ? k + 1 : ""}`, { title: { text: "looks" }, gridcolor: line, zeroline: false, rangemode: "tozero" }],
    ]));
    const traces = names.map((name, k) => {
      const known = told.estimates.filter((one) => name in one.deg_per_step);
      return {
        name, mode: "lines+markers", xaxis: `x${k ? k + 1 : ""}`, yaxis: `y${k ? k + 1 : ""}`,
        x: known.map((one) => one.looks), y: known.map((one) => one.deg_per_step[name]),
        error_y: { type: "data", array: known.map((one) => 1.96 * one.u_deg_per_step[name]) },
        marker: { color: COLOURS[name] ?? ink }, line: { color: COLOURS[name] ?? ink },
      };
    });
    const columns = by("history").clientWidth < 700 ? 1 : Math.min(2, names.length);
    const count = Math.ceil(names.length / columns);
    by("history").style.height = `${Math.max(260, 210 * count)}px`;
    const layout = {
      ...axes, grid: { rows: count, columns, pattern: "independent" }, showlegend: false,
      margin: { l: 70, r: 10, t: 10, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink, size: 11 },
    };
    Plotly.react(by("history"), traces, layout, { responsive: true, displayModeBar: false });
  }

  /** Both pictures, small, and the surroundings of the spot with the centre that was found. */
  async showLook({ look, trail, image_px: [width, height] }) {
    const mark = look === null ? "none" : `${look.spot}/${look.status}/${look.pictured.length}`;
    if (mark === this.shown.look) return;
    this.shown.look = mark;
    for (const [k, camera] of ["left", "right"].entries()) {
      const [whole, spot] = by(camera).querySelectorAll("svg");
      const centre = look?.pixels_px ? look.pixels_px.slice(2 * k, 2 * k + 2) : null;
      whole.setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
      const parts = [];
      if (look?.pictured.includes(camera)) {
        const href = await this.fetched(`/live/${look.spot}/${camera}/whole`);
        if (href) parts.push(element("image", { href, x: -0.5, y: -0.5, width, height }));
      }
      for (const past of trail) parts.push(element("circle", { cx: past[2 * k], cy: past[2 * k + 1], r: 5, class: "trail" }));
      if (centre) parts.push(element("circle", { cx: centre[0], cy: centre[1], r: 24, class: "centre" }));
      parts.push(element("text", { x: 16, y: 44 }, camera));
      whole.replaceChildren(...parts);
      await this.showSpot(spot, look, camera, centre);
    }
    const remark = look === null ? "no look yet" : `look ${look.spot} at ${look.target}: ${look.status}${look.pictured.length ? "" : "; no pictures are made"}`;
    const centres = look?.pixels_px ? `; centre left ${look.pixels_px.slice(0, 2).map((v) => v.toFixed(2)).join(", ")}, right ${look.pixels_px.slice(2).map((v) => v.toFixed(2)).join(", ")} px` : "";
    by("look-remark").textContent = `${remark}${centres}`;
    document.body.dataset.look = look?.spot ?? "";
  }

  async showSpot(spot, look, camera, centre) {
    const half = WINDOW_PX / 2;
    // Python rounds halves to the even number, as the cut-out is made.
    const even = (value) => (Math.abs(value % 1) === 0.5 ? 2 * Math.round(value / 2) : Math.round(value));
    const [u, v] = (centre ?? [0, 0]).map(even);
    spot.setAttribute("viewBox", `${u - half - 0.5} ${v - half - 0.5} ${WINDOW_PX} ${WINDOW_PX}`);
    const parts = [];
    if (centre) {
      const href = look.pictured.includes(camera) ? await this.fetched(`/live/${look.spot}/${camera}/spot`) : null;
      if (href) parts.push(element("image", { href, x: u - half - 0.5, y: v - half - 0.5, width: WINDOW_PX, height: WINDOW_PX }));
      const [x, y] = centre;
      parts.push(element("path", { d: `M${x - 5} ${y}H${x + 5}M${x} ${y - 5}V${y + 5}`, class: "centre" }));
    }
    spot.replaceChildren(...parts);
  }

  /** A picture as an address of this page; null where a newer look has taken its place. */
  async fetched(path) {
    try {
      const blob = await (await asked(path, this.key, { signal: AbortSignal.timeout(LATE_MS) })).blob();
      if (!blob.size) return null;
      return await new Promise((done) => {
        const reader = new FileReader();
        reader.addEventListener("load", () => done(reader.result));
        reader.readAsDataURL(blob);
      });
    } catch {
      return null;
    }
  }
}

try {
  const key = await keyOf();
  await asked("/live", key);
  await new LivePage(key).watch();
} catch (error) {
  by("notes").textContent = error.message;
  by("notes").classList.add("refused");
  document.body.dataset.state = "refused";
  throw error;
}
