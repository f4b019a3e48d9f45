// The page: the key for the link's token, the document, the plots, and one selection that all of them share.

import { asked, keyOf } from "./access.js";
import { Scenes } from "./columns.js";
import { Changes, Correlation, MARKS_MOST, Pictures, Residuals, Stops } from "./plots.js";
import { Rig, VIEWS } from "./rig.js";

const by = (id) => document.getElementById(id);

function refuse(text) {
  by("notes").textContent = text;
  by("notes").classList.add("refused");
  document.body.dataset.state = "refused";
}

function digits(value, sd) {
  if (!Number.isFinite(value)) return "";
  if (!(sd > 0)) return value.toPrecision(6);
  const places = Math.min(12, Math.max(0, 1 - Math.floor(Math.log10(sd))));
  return value.toFixed(places);
}

function cells(row, texts, numbersFrom = Infinity) {
  texts.forEach((text, k) => {
    const cell = row.insertCell();
    cell.textContent = text;
    if (k >= numbersFrom) cell.className = "number";
  });
  return row;
}

function tableOf(heads, numbersFrom) {
  const table = document.createElement("table");
  const head = table.createTHead().insertRow();
  heads.forEach((text, k) => {
    const cell = document.createElement("th");
    cell.textContent = text;
    if (k >= numbersFrom) cell.className = "number";
    head.append(cell);
  });
  table.createTBody();
  return table;
}

class Page {
  constructor(scenes, key) {
    const fetched = async (path) => URL.createObjectURL(await (await asked(path, key)).blob());
    this.scenes = scenes;
    this.rig = new Rig(by("rig"), scenes);
    this.residuals = new Residuals(by("residuals"), scenes);
    this.stops = new Stops(by("stops"), scenes);
    this.pictures = new Pictures(by("pictures"), scenes, fetched);
    this.correlation = new Correlation(by("correlation"), scenes);
    this.places = [];
    this.marked = [];
  }

  async draw() {
    const { all, told } = this.scenes;
    by("name").textContent = all.map((scene) => scene.name).join(" beside ");
    document.title = `${all[0].name} - tvsbayes view`;
    by("notes").textContent = all.flatMap((scene) => scene.notes.map((note) => `${scene.name}: ${note}`)).join("; ");
    for (const [k, scene] of all.entries()) by("campaign").add(new Option(scene.name, k));
    by("campaign").hidden = all.length < 2;
    if (all.length > 1) by("whose").textContent = ` of the first, ${all[0].name}`;
    for (const plot of [this.rig, this.residuals, this.stops, this.pictures, this.correlation]) await plot.draw();
    by("rig-remark").textContent = this.rig.remark();
    by("residuals-remark").textContent = this.residuals.remark();
    by("correlation-figure").hidden = !all[0].correlation.names.length;
    this.listParameters();
    if (told.changes !== null) await this.showChanges(told.changes);
    this.wire();
    if (this.scenes.count) await this.choose([0]);
  }

  async showChanges(changes) {
    by("changes-figure").hidden = false;
    await new Changes(by("changes"), this.scenes).draw();
    by("verdict").textContent = changes.verdict;
    const table = tableOf(["quantity", "unit", "A", "B", "B - A", "u", "(B - A) / u"], 2);
    for (const c of changes.changes) {
      const told = c.normalised === null ? "" : c.normalised.toFixed(2);
      const numbers = [c.first, c.second, c.difference].map((value) => digits(value, c.u));
      const row = cells(table.tBodies[0].insertRow(), [c.quantity, c.unit, ...numbers, c.u.toPrecision(2), told], 2);
      row.classList.toggle("significant", c.significant);
    }
    by("changes-table").replaceChildren(table);
  }

  listParameters() {
    const { fitted, parameters } = this.scenes.all[0];
    const table = tableOf(["parameter", "unit", fitted ? "value" : "stated", fitted ? "sd" : "u", "told by the data"], 2);
    for (const p of parameters) {
      const share = p.contraction === null ? "" : `${(100 * p.contraction).toFixed(0)} %`;
      const texts = [p.name, p.unit, digits(p.value, p.sd), p.sd.toPrecision(2), share];
      const row = cells(table.tBodies[0].insertRow(), texts, 2);
      row.dataset.name = p.name;
      row.tabIndex = 0;
      row.addEventListener("click", () => this.mark([p.name]));
      row.addEventListener("keydown", (event) => { if (event.key === "Enter") this.mark([p.name]); });
    }
    by("parameters").replaceChildren(table);
  }

  rows() {
    return [...by("parameters").querySelectorAll("tbody tr")];
  }

  async mark(names) {
    this.marked = names;
    for (const row of this.rows()) row.classList.toggle("marked", names.includes(row.dataset.name));
    this.rows().find((row) => row.dataset.name === names[0])?.scrollIntoView({ block: "nearest" });
    if (!by("correlation-figure").hidden) by("correlation-remark").textContent = await this.correlation.mark(names);
  }

  async choose(places) {
    this.places = places;
    const marked = places.length > MARKS_MOST ? `, ${MARKS_MOST} are marked` : "";
    by("chosen").textContent = places.length > 1 ? `${places.length} looks are selected${marked}` : "";
    for (const plot of [this.rig, this.residuals, this.stops]) await plot.choose(places);
    if (places.length) await this.showLook(places[0]);
    document.body.dataset.chosen = places.length;
  }

  async showLook(place) {
    this.current = place;
    const { number, scene, row } = this.scenes.at(place);
    by("campaign").value = number;
    by("look").value = scene.looks.at("spot", row);
    this.listFacts(scene, row);
    await this.pictures.show(place);
    by("pictures-remark").textContent = this.pictures.remark();
  }

  listFacts({ looks, fitted }, row) {
    const direction = looks.texts.direction[row].map((word) => word || "unknown").join(", ");
    const pair = (name, k, sd) => `${digits(looks.at(name, row, k), sd)}, ${digits(looks.at(name, row, k + 1), sd)}`;
    const axes = looks.row("ellipsoid_mm", row);
    const halves = [0, 1, 2].map((a) => Math.hypot(...axes.subarray(3 * a, 3 * a + 3))).sort((a, b) => b - a);
    const facts = [
      ["status", looks.texts.status[row] + (looks.at("suspect", row) ? "; the fit doubts it or left it out" : "")],
      ["sheet", looks.texts.target[row]],
      ["after move", `${looks.at("move", row)}, to pan ${looks.at("steps", row, 0)}, tilt ${looks.at("steps", row, 1)} steps`],
      ["came", direction],
    ];
    if (Number.isFinite(looks.at("pixels_px", row))) {
      const [left, right] = [0, 2].map((k) => `${pair("pixels_px", k, 0.01)} (sd ${pair("sd_px", k, 0.01)})`);
      facts.push(["centre left, px", left], ["centre right, px", right]);
      facts.push(["point, mm", [0, 1, 2].map((k) => digits(looks.at("point_mm", row, k), 0.1)).join(", ")]);
      facts.push(["half axes of 95 %, mm", halves.map((half) => half.toPrecision(2)).join(", ")]);
    }
    if (fitted && Number.isFinite(looks.at("residual_px", row))) {
      facts.push(["residual left, px", pair("residual_px", 0, 0.01)], ["residual right, px", pair("residual_px", 2, 0.01)]);
    }
    ["pan", "tilt"].forEach((axis, k) => {
      const [off, u] = [looks.at("deviation_deg", row, k), looks.at("u_deg", row, k)];
      if (Number.isFinite(off)) facts.push([`${axis} stop off, deg`, `${digits(off, u)} (sd ${u.toPrecision(2)})`]);
    });
    const body = document.createElement("tbody");
    for (const [name, text] of facts) {
      const line = body.insertRow();
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = name;
      line.append(head);
      line.insertCell().textContent = text;
    }
    by("facts").replaceChildren(body);
  }

  /** The next place for which `wanted` holds, going round. */
  walk(step, wanted = () => true) {
    const from = this.current ?? -step;
    for (let k = 1; k <= this.scenes.count; k++) {
      const place = (((from + k * step) % this.scenes.count) + this.scenes.count) % this.scenes.count;
      if (wanted(place)) return this.choose([place]);
    }
    by("chosen").textContent = "the fit doubts no look";
    return null;
  }

  wire() {
    by("previous").addEventListener("click", () => this.walk(-1));
    by("next").addEventListener("click", () => this.walk(1));
    by("none").addEventListener("click", () => this.choose([]));
    const doubted = (place) => { const { scene, row } = this.scenes.at(place); return scene.looks.at("suspect", row) === 1; };
    by("unlikely").addEventListener("click", () => this.walk(1, doubted));
    const asksFor = () => {
      const place = this.scenes.placeOf(Number(by("campaign").value || 0), Number(by("look").value));
      if (place >= 0) this.choose([place]);
      else by("chosen").textContent = `there is no look ${by("look").value}`;
    };
    for (const id of ["look", "campaign"]) by(id).addEventListener("change", asksFor);
    for (const [id, name] of Object.entries({ spots: "spots", ellipsoids: "ellipsoids", beams: "beams", mirrors: "mirrors",
      cameras: "cameras", sheets: "sheets" })) {
      by(`show-${id}`).addEventListener("change", (event) => this.rig.show(name, event.target.checked));
    }
    by("ellipsoid-scale").addEventListener("change", (event) => this.rig.enlarge(Number(event.target.value)));
    by("residual-scale").addEventListener("change", (event) => this.residuals.enlarge(Number(event.target.value)));
    for (const view of Object.keys(VIEWS)) by(view).addEventListener("click", () => this.rig.look(view));
    by("window-spot").addEventListener("change", () => this.pictures.widen(false));
    by("window-all").addEventListener("change", () => this.pictures.widen(true));
    by("show-gears").addEventListener("change", (event) => this.stops.show("gears", event.target.checked));
    by("show-u").addEventListener("change", (event) => this.stops.show("u", event.target.checked));
    by("filter").addEventListener("input", (event) => {
      for (const row of this.rows()) row.hidden = !row.dataset.name.includes(event.target.value.trim());
    });
    this.link();
    for (const place of document.querySelectorAll(".tools")) offerExports(place, this.scenes.all[0].name);
  }

  /** What is clicked or framed in one plot is selected in all. */
  link() {
    const placesOf = (event) => {
      const found = event?.points.map((point) => point.customdata).filter((place) => place !== undefined) ?? [];
      return [...new Set(found)].sort((a, b) => a - b);
    };
    for (const id of ["rig", "residuals", "stops"]) {
      by(id).on("plotly_click", (event) => { const places = placesOf(event); if (places.length) this.choose(places); });
    }
    for (const id of ["residuals", "stops"]) {
      by(id).on("plotly_selected", (event) => { const places = this[id].framed(event); if (places.length) this.choose(places); });
    }
    by("correlation").on("plotly_click", ({ points: [point] }) => this.mark([point.y, point.x]));
  }
}

/** Buttons that save a plot as it is seen. */
function offerExports(place, name) {
  for (const format of ["png", "svg"]) {
    const button = document.createElement("button");
    const plot = by(place.dataset.plot);
    button.type = "button";
    button.id = `save-${place.dataset.plot}-${format}`;
    button.textContent = format.toUpperCase();
    button.title = `save as ${format.toUpperCase()}`;
    button.addEventListener("click", async () => {
      const filename = `${name.replace(/[^A-Za-z0-9]+/g, "-")}-${place.dataset.plot}`;
      const { clientWidth: width, clientHeight: height } = plot;
      await Plotly.downloadImage(plot, { format, filename, width, height, scale: format === "png" ? 2 : 1 });
    });
    place.append(button);
  }
}

try {
  const key = await keyOf();
  const told = await (await asked("/scene", key)).json();
  await new Page(new Scenes(told), key).draw();
  document.body.dataset.state = "ready";
} catch (error) {
  refuse(error.message);
  throw error;
}
