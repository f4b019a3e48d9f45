// The page of a run: what it says twice a second. It shows, the terminal acts.

const TOKEN = "tvsbayes-token";
const POLL_MS = 500;
const LATE_MS = 3000;
const GONE_AFTER = 4;
const WINDOW_PX = 48;
const DIRECTIONS = ["left", "right", "up", "down"];
const WORDS = { running: "the run goes on", ended: "the run has ended" };
const NOISY = 2;

/** The token of the link behind the #, kept over a reload of this tab. */
function tokenOf() {
  const token = location.hash.slice(1);
  if (token) {
    history.replaceState(null, "", "/");
    sessionStorage.setItem(TOKEN, token);
  }
  return sessionStorage.getItem(TOKEN) ?? "";
}

/** An answer of the page's own server; `how` as of fetch. */
async function asked(path, token, how = {}) {
  const answer = await fetch(path, { ...how, headers: { "X-Tvsbayes-Token": token } });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

/** A value with its standard uncertainty in units of the last digit: 0.0775(22). */
function withU(value, u) {
  const places = Math.max(0, 1 - Math.floor(Math.log10(u)));
  return `${value.toFixed(places)}(${Math.round(u * 10 ** places)})`;
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
  constructor(token) {
    this.token = token;
    this.shown = { estimates: 0, look: null };
    this.panels = {};
  }

  async refresh() {
    this.latest = await (await asked("/live", this.token, { signal: AbortSignal.timeout(LATE_MS) })).json();
    await this.show(this.latest);
  }

  async watch() {
    let missed = 0;
    while (document.body.dataset.state !== "ended") {
      try {
        await this.refresh();
        missed = 0;
        document.body.dataset.state = this.latest.state;
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
  }

  async show(told) {
    by("name").textContent = told.name || "run";
    document.title = `${told.state}: ${told.name} - tvsbayes acquire`;
    const reason = told.state === "ended" ? `: ${told.reason}` : "";
    by("notes").textContent = `${told.simulated ? "simulated; " : ""}${WORDS[told.state]}${reason}`;
    by("fault").hidden = told.fault === null;
    if (told.fault) {
      const { message, remedy } = told.fault;
      by("fault").textContent = remedy && !message.includes(remedy) ? `${message}; ${remedy}` : message;
    }
    this.showRun(told);
    this.showEstimates(told);
    const remarks = [...told.warnings.map((text) => `warning: ${text}`), ...told.remarks.toReversed()];
    by("remarks").replaceChildren(...(remarks.length ? remarks : ["none"]).map((text) => {
      const item = document.createElement("li");
      item.textContent = text;
      return item;
    }));
    await this.showLook(told);
  }

  showRun({ progress, coming, device, state }) {
    if (!progress) return rows(by("facts"), [], [["before the first step"]]);
    by("bar").max = progress.steps;
    by("bar").value = state === "ended" ? Math.max(progress.step, by("bar").value) : progress.step;
    const place = device ? `${device.status} at pan ${device.pan_steps}, tilt ${device.tilt_steps}` : "not asked yet";
    rows(by("facts"), [], [
      ["now", state === "ended" ? "ended" : progress.doing],
      ["then", state === "ended" ? "" : coming.join(", ") || "the end of the plan"],
      ["step", `${progress.step} of ${progress.steps}`],
      ["look", `${progress.looks} of ${progress.looks_total}; ${progress.refused} refused, ${progress.retries} repeated`],
      ["time left", state === "ended" ? "" : `about ${time(progress.seconds_left)} by [costs] of the rig file`],
      ["device", place],
    ].filter(([, text]) => text));
  }

  showEstimates(told) {
    const { estimates, aim, temperature, simulated } = told;
    const target = aim.target_u_deg_per_step;
    const names = DIRECTIONS.filter((name) => aim.directions.includes(name));
    const wanted = target === null ? "" : `; wanted: u at most ${target.toPrecision(2)} in ${names.join(", ")}`;
    if (!estimates.length) {
      by("estimate-remark").textContent = `no estimate yet${simulated ? "; a simulation makes them with --estimate" : ""}${wanted}`;
      return;
    }
    const last = estimates.at(-1);
    const heat = temperature?.rms ?? null;
    const drift = heat === null ? "" : `. Temperature ${heat.toFixed(1)}: how far the newest looks moved it, in sd of how far they should; `
      + (heat > NOISY ? "well above 1: drift, lost steps, something knocked?" : "about 1 is calm");
    by("estimate-remark").textContent = `of ${last.looks} looks${wanted}${drift}`;
    if (estimates.length === this.shown.estimates) return;
    this.shown.estimates = estimates.length;
    const heads = ["direction", "deg/step (u)", ...(target === null ? [] : ["target"]), "moved, sd"];
    rows(by("estimates"), heads, Object.entries(last.deg_per_step).map(([name, value]) => {
      const u = last.u_deg_per_step[name];
      const moved = temperature?.moved[name] ?? null;
      const met = !aim.directions.includes(name) ? "" : u <= target ? "met" : `u is ${(u / target).toFixed(1)} times the target`;
      return [name, withU(value, u), ...(target === null ? [] : [met]), [moved === null ? "" : moved.toFixed(1).replace("-0.0", "0.0"), Math.abs(moved) > 3 ? "hot" : ""]];
    }));
    this.drawHistory(told);
  }

  /** Every estimate with its 95 % bars over the looks it was made of, a chart for each direction. */
  drawHistory({ estimates }) {
    for (const name of Object.keys(estimates.at(-1).deg_per_step)) {
      const place = document.createElement("div");
      this.panels[name] ??= new Panel(by("history").appendChild(place), { title: `${name}, deg/step`, x: { title: "looks", fromZero: true }, y: {} });
      const known = estimates.filter((one) => name in one.deg_per_step)
        .map((one) => [one.looks, one.deg_per_step[name], 1.96 * one.u_deg_per_step[name]]);
      const look = { colour: `var(--${name})` };
      this.panels[name].put(
        lines("u", known.flatMap(([x, y, u]) => [[x, y - u], [x, y + u], null]), look),
        lines("way", known.map(([x, y]) => [x, y]), { ...look, opacity: 0.5 }),
        dots("estimates", known.map(([x, y]) => [x, y]), { ...look, glyph: name, texts: known.map(([x, y, u]) => `${x} looks: ${withU(y, u / 1.96)}`), places: known.map(([x]) => x) }),
      );
    }
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
        if (href) parts.push(node("image", { href, x: -0.5, y: -0.5, width, height }));
      }
      for (const past of trail) parts.push(node("circle", { cx: past[2 * k], cy: past[2 * k + 1], r: 5, class: "trail" }));
      if (centre) parts.push(node("circle", { cx: centre[0], cy: centre[1], r: 24, class: "centre" }));
      parts.push(node("text", { x: 16, y: 44 }, camera));
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
      if (href) parts.push(node("image", { href, x: u - half - 0.5, y: v - half - 0.5, width: WINDOW_PX, height: WINDOW_PX }));
      const [x, y] = centre;
      parts.push(node("path", { d: `M${x - 5} ${y}H${x + 5}M${x} ${y - 5}V${y + 5}`, class: "centre" }));
    }
    spot.replaceChildren(...parts);
  }

  /** A picture as an address of this page; null where a newer look has taken its place. */
  async fetched(path) {
    try {
      const blob = await (await asked(path, this.token, { signal: AbortSignal.timeout(LATE_MS) })).blob();
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

async function start() {
  try {
    const token = tokenOf();
    await asked("/live", token);
    await new LivePage(token).watch();
  } catch (error) {
    by("notes").textContent = error.message;
    by("notes").classList.add("refused");
    document.body.dataset.state = "refused";
    throw error;
  }
}

start();
