// The page of a campaign: its plots, and one selection that all of them share. The document stands in the page itself.

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
  constructor(scenes) {
    this.scenes = scenes;
    this.plots = {
      rig: new Rig(by("rig"), scenes), pictures: new Pictures(by("pictures"), scenes), residuals: new Residuals(by("residuals"), scenes),
      stops: new Stops(by("stops"), scenes), correlation: new Correlation(by("correlation"), scenes), changes: new Changes(by("changes"), scenes),
    };
    for (const plot of Object.values(this.plots)) plot.choice = (places) => this.choose(places);
    this.plots.correlation.choice = (names) => this.mark(names);
    this.places = [];
  }

  draw() {
    const { all, sent } = this.scenes;
    by("name").textContent = all.map((scene) => scene.name).join(" beside ");
    document.title = `${all[0].name} - tvsbayes view`;
    by("notes").textContent = all.flatMap((scene) => scene.notes.map((note) => `${scene.name}: ${note}`)).join("; ");
    for (const [k, scene] of all.entries()) by("campaign").add(new Option(scene.name, k));
    by("campaign").hidden = all.length < 2;
    ["first-name", "second-name"].forEach((id, k) => { by(id).textContent = all[k]?.name ?? ""; });
    for (const row of document.querySelectorAll(".second")) row.hidden = all.length < 2;
    if (all.length > 1) by("whose").textContent = ` of the first, ${all[0].name}`;
    const { rig, pictures, residuals, stops, correlation } = this.plots;
    for (const plot of [rig, pictures, residuals, stops]) plot.draw();
    by("rig-remark").textContent = rig.remark();
    by("residuals-remark").textContent = residuals.remark();
    by("correlation-figure").hidden = !all[0].correlation.names.length;
    if (all[0].correlation.names.length) correlation.draw();
    this.listParameters();
    if (sent.changes !== null) this.showChanges(sent.changes);
    this.wire();
    if (this.scenes.count) this.choose([0]);
  }

  showChanges(changes) {
    by("changes-figure").hidden = false;
    this.plots.changes.draw();
    by("verdict").textContent = changes.verdict;
    const table = tableOf(["quantity", "A", "B", "B - A", "u", "unit", "(B - A) / u"], 1);
    for (const c of changes.changes) {
      const normalised = c.normalised === null ? "" : digits(c.normalised, 0.1);
      const numbers = [c.first, c.second, c.difference, c.u].map((value) => digits(value, c.u));
      const row = cells(table.tBodies[0].insertRow(), [c.quantity, ...numbers, c.unit, normalised], 1);
      row.classList.toggle("significant", c.significant);
    }
    by("changes-table").replaceChildren(table);
  }

  listParameters() {
    const { fitted, parameters } = this.scenes.all[0];
    const table = tableOf(["parameter", fitted ? "value" : "stated", fitted ? "sd" : "u", "unit", "from the data"], 1);
    for (const p of parameters) {
      const share = p.contraction === null ? "" : `${(100 * p.contraction).toFixed(0)} %`;
      const texts = [p.name, digits(p.value, p.sd), p.sd > 0 ? digits(p.sd, p.sd) : "0", p.unit, share];
      const row = cells(table.tBodies[0].insertRow(), texts, 1);
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

  mark(names) {
    for (const row of this.rows()) row.classList.toggle("marked", names.includes(row.dataset.name));
    this.rows().find((row) => row.dataset.name === names[0])?.scrollIntoView({ block: "nearest" });
    if (!by("correlation-figure").hidden) by("correlation-remark").textContent = this.plots.correlation.mark(names);
  }

  choose(places) {
    this.places = places;
    const marked = places.length > MARKS_MOST ? `, ${MARKS_MOST} are marked` : "";
    by("chosen").textContent = places.length > 1 ? `${places.length} looks are selected${marked}` : "";
    const { rig, residuals, stops } = this.plots;
    for (const plot of [rig, residuals, stops]) plot.choose(places);
    if (places.length) this.showLook(places[0]);
    document.body.dataset.chosen = places.length;
  }

  showLook(place) {
    this.current = place;
    const { number, scene, row } = this.scenes.at(place);
    by("campaign").value = number;
    by("look").value = scene.looks.at("spot", row);
    this.listFacts(scene, row);
    this.plots.pictures.show(place);
    by("pictures-remark").textContent = this.plots.pictures.remark();
  }

  listFacts({ looks, fitted }, row) {
    const direction = looks.texts.direction[row].map((word) => word || "unknown").join(", ");
    const pair = (name, k, sd) => `${digits(looks.at(name, row, k), sd)}, ${digits(looks.at(name, row, k + 1), sd)}`;
    const axes = looks.row("ellipsoid_mm", row);
    const halves = [0, 1, 2].map((a) => Math.hypot(...axes.subarray(3 * a, 3 * a + 3))).sort((a, b) => b - a);
    const facts = [
      ["status", looks.texts.status[row] + (looks.at("suspect", row) ? "; the fit finds it unlikely or left it out" : "")],
      ["sheet", looks.texts.target[row]],
      ["after move", `${looks.at("move", row)}, to pan ${looks.at("steps", row, 0)}, tilt ${looks.at("steps", row, 1)} steps`],
      ["came", direction],
    ];
    if (Number.isFinite(looks.at("pixels_px", row))) {
      const [left, right] = [0, 2].map((k) => `${pair("pixels_px", k, 0.01)} (sd ${pair("sd_px", k, 0.01)})`);
      facts.push(["centre left, px", left], ["centre right, px", right]);
      facts.push(["point, mm", [0, 1, 2].map((k) => digits(looks.at("point_mm", row, k), 0.1)).join(", ")]);
      facts.push(["half axes of 95 %, mm", halves.map((half) => digits(half, half)).join(", ")]);
    }
    if (fitted && Number.isFinite(looks.at("residual_px", row))) {
      facts.push(["residual left, px", pair("residual_px", 0, 0.01)], ["residual right, px", pair("residual_px", 2, 0.01)]);
    }
    ["pan", "tilt"].forEach((axis, k) => {
      const [off, u] = [looks.at("deviation_deg", row, k), looks.at("u_deg", row, k)];
      if (Number.isFinite(off)) facts.push([`${axis} stop off, deg`, `${digits(off, u)} (sd ${digits(u, u)})`]);
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
    by("chosen").textContent = "the fit finds no look unlikely";
    return null;
  }

  wire() {
    const { rig, residuals, stops, pictures } = this.plots;
    const on = (id, event, act) => by(id).addEventListener(event, ({ target }) => act(target));
    on("previous", "click", () => this.walk(-1));
    on("next", "click", () => this.walk(1));
    on("none", "click", () => this.choose([]));
    const unlikely = (place) => { const { scene, row } = this.scenes.at(place); return scene.looks.at("suspect", row) === 1; };
    on("unlikely", "click", () => this.walk(1, unlikely));
    const goTo = () => {
      const wanted = Number(by("look").value);
      by("look").value = wanted;
      const place = this.scenes.placeOf(Number(by("campaign").value || 0), wanted);
      if (place >= 0) this.choose([place]);
      else by("chosen").textContent = `there is no look ${wanted}`;
    };
    for (const id of ["look", "campaign"]) on(id, "change", goTo);
    for (const name of ["spots", "ellipsoids", "beams", "mirrors", "cameras", "sheets"]) {
      on(`show-${name}`, "change", ({ checked }) => rig.show(name, checked));
    }
    on("ellipsoid-scale", "change", ({ value }) => rig.enlarge(Number(value)));
    on("residual-scale", "change", ({ value }) => { residuals.enlarge(Number(value)); residuals.choose(this.places); });
    for (const view of Object.keys(VIEWS)) on(view, "click", () => rig.look(view));
    on("window-spot", "change", () => pictures.widen(false));
    on("window-all", "change", () => pictures.widen(true));
    on("show-gears", "change", ({ checked }) => stops.show(["gears", "gear means"], checked));
    on("show-u", "change", ({ checked }) => stops.show(["u"], checked));
    on("filter", "input", ({ value }) => {
      for (const row of this.rows()) row.hidden = !row.dataset.name.includes(value.trim());
    });
    for (const place of document.querySelectorAll(".tools")) this.offer(place, place.dataset.plot);
  }

  /** Buttons of a plot: its size, what dragging does, and the plot as a file as it is seen. */
  offer(place, name) {
    const plot = this.plots[name];
    const button = (id, text, title, act) => {
      const made = document.createElement("button");
      Object.assign(made, { type: "button", id: `${id}-${name}`, textContent: text, title });
      made.addEventListener("click", act);
      place.append(made);
    };
    if (plot instanceof Plane) {
      const modes = document.createElement("select");
      Object.assign(modes, { id: `mode-${name}`, title: "what dragging does" });
      for (const [value, text] of [["frame", "select in a frame"], ["lasso", "select in a lasso"], ["move", "move the plot"]]) modes.add(new Option(text, value));
      modes.addEventListener("change", () => plot.all((panel) => { panel.mode = modes.value; }));
      place.append(modes);
    }
    button("larger", "+", "larger; also Ctrl and the wheel", () => plot.all((panel) => panel.zoom(ZOOM)));
    button("smaller", "\u2212", "smaller", () => plot.all((panel) => panel.zoom(1 / ZOOM)));
    button("whole", "all", "all of it; also a double click", () => plot.all((panel) => panel.whole()));
    const file = `${this.scenes.all[0].name.replace(/[^A-Za-z0-9]+/g, "-")}-${name}`;
    for (const format of ["png", "svg"]) {
      button(`save-${format}`, format.toUpperCase(), `save as ${format.toUpperCase()}`, () => save(plot.element, file, format));
    }
  }
}

document.page = new Page(new Scenes(JSON.parse(by("document").textContent)));
document.page.draw();
document.body.dataset.state = "ready";
