// The plane plots: pictures of a look, residuals over the images, stops over the counters, correlations, changes.

const COLOURS = ["var(--first)", "var(--second)"];
const CHOSEN = "var(--chosen)";
/** Of very many looks so many have a dot, an arrow, a bar: every change of a plot costs time for all it shows. */
const DOTS_MOST = 3000;
const ARROWS_MOST = 2000;
const BARS_MOST = 1000;
const MARKS_MOST = 3000;
const MARK_PX = 6;
/** Half of what is shown around a spot. */
const WINDOW_PX = 24;
const AXES = ["pan", "tilt"];

/** A plot of several charts. */
class Plot {
  constructor(element, scenes) {
    Object.assign(this, { element, scenes, panels: [] });
  }

  all(act) { for (const panel of this.panels) act(panel); }
}

/** At most so many of a list, evenly chosen. */
function some(list, most) {
  if (list.length <= most) return list;
  return Array.from({ length: most }, (_, k) => list[Math.floor((k * list.length) / most)]);
}

/** What both planes share: two charts side by side, each with a mark a look, and marks on what is selected. */
class Plane extends Plot {
  /** Where a look stands in one of the charts; not a number where that is not known. */
  point(looks, row, k) { throw new Error("of the kind of plane", { cause: [looks, row, k] }); }

  build(axes, titles) {
    this.panels = titles.map((title, k) => {
      const panel = new Panel(this.element, { title, ...axes });
      panel.mode = "frame";
      panel.picked = (place) => this.choice([place]);
      panel.selected = (inside) => {
        const places = this.scenes.all.flatMap(({ looks }) => [...looks.places()].filter((_, row) => inside(...this.point(looks, row, k))));
        if (places.length) this.choice(places);
      };
      return panel;
    });
  }

  /** Marks of some looks of one campaign, in one of the charts. */
  marks(name, number, rows, k, more) {
    const { looks } = this.scenes.all[number];
    const points = rows.map((row) => this.point(looks, row, k));
    const places = rows.map((row) => looks.first + row);
    const texts = rows.map((row) => this.text(looks, row, k));
    return dots(name, points, { colour: COLOURS[number], size: looks.count > DOTS_MOST ? 1.5 : 2.5, places, texts, ...more });
  }

  choose(places) {
    const byScene = this.scenes.rowsBy(some(places, MARKS_MOST));
    this.panels.forEach((panel, k) => {
      const points = byScene.flatMap((rows, number) => rows.map((row) => this.point(this.scenes.all[number].looks, row, k)));
      panel.put(dots("chosen", points, { colour: CHOSEN, size: MARK_PX, glyph: "diamond", hollow: true }), ...this.alsoChosen(byScene, k));
    });
  }

  alsoChosen() { return []; }
}

class Residuals extends Plane {
  constructor(element, scenes) {
    super(element, scenes);
    this.scale = 30;
  }

  point(looks, row, camera) {
    return [looks.at("pixels_px", row, 2 * camera), looks.at("pixels_px", row, 2 * camera + 1)];
  }

  text(looks, row, camera) {
    return `look ${looks.at("spot", row)}: ${this.point(looks, row, camera).map((v) => v.toFixed(2)).join(", ")} px`;
  }

  arrows(looks, rows, camera) {
    return rows.flatMap((row) => {
      const [u, v] = this.point(looks, row, camera);
      const [du, dv] = [0, 1].map((k) => looks.at("residual_px", row, 2 * camera + k));
      return Number.isFinite(du + dv) ? [[u, v], [u + this.scale * du, v + this.scale * dv], null] : [];
    });
  }

  draw() {
    const [width, height] = this.scenes.all[0].image_px;
    const x = { range: [-0.5, width - 0.5], title: "u, px" };
    this.build({ x, y: { range: [height - 0.5, -0.5], title: "v, px" }, equal: true }, this.scenes.sent.cameras);
    this.panels.forEach((panel, camera) => {
      panel.put(...this.scenes.all.map(({ looks }, number) =>
        this.marks(`looks ${number}`, number, looks.some("pixels_px", DOTS_MOST), camera, {})));
    });
    this.enlarge(this.scale);
  }

  remark() {
    const marked = this.scenes.all.map(({ looks }) => looks.some("pixels_px", DOTS_MOST).length).join(" and ");
    const how = "Drag over looks to select them, all of them, in all plots.";
    if (!this.scenes.all.some((scene) => scene.fitted)) return `No residuals without a fit; dots: centres of ${marked} looks. ${how}`;
    const drawn = this.scenes.all.map(({ looks }) => looks.some("residual_px", ARROWS_MOST).length).join(" and ");
    return `Dots of ${marked} looks, arrows of ${drawn}. ${how}`;
  }

  enlarge(scale) {
    this.scale = scale;
    this.panels.forEach((panel, camera) => panel.put(...this.scenes.all.map(({ looks }, number) =>
      lines(`arrows ${number}`, this.arrows(looks, looks.some("residual_px", ARROWS_MOST), camera), { colour: COLOURS[number] }))));
  }

  alsoChosen(byScene, camera) {
    const points = byScene.flatMap((rows, number) => this.arrows(this.scenes.all[number].looks, rows, camera));
    return [lines("chosen arrows", points, { colour: CHOSEN, width: 2 })];
  }
}

class Stops extends Plane {
  point(looks, row, k) {
    return [looks.at("steps", row, k), looks.at("deviation_deg", row, k)];
  }

  text(looks, row, k) {
    const [steps, off] = this.point(looks, row, k);
    return `look ${looks.at("spot", row)}, came ${looks.texts.direction[row][k] || "unknown"}: ${steps} steps, ${off.toFixed(4)} deg`;
  }

  draw() {
    this.build({ x: { title: "counter, steps" }, y: { title: "deviation, deg" } }, AXES);
    this.panels.forEach((panel, k) => panel.put(...this.scenes.all.flatMap((scene, number) => this.layers(scene, number, k))));
  }

  layers({ looks, gears }, number, k) {
    const colour = COLOURS[number];
    const rows = looks.some("deviation_deg", DOTS_MOST, k);
    const bars = some(rows, BARS_MOST).flatMap((row) => {
      const [steps, off] = this.point(looks, row, k);
      const u = looks.at("u_deg", row, k);
      return [[steps, off - u], [steps, off + u], null];
    });
    const bands = gears.filter((band) => band.axis === AXES[k]);
    const edge = (band, which) => band.steps.map((steps, i) => [steps, band.error_deg[which][i]]);
    // A mark shows the side of arrival: shape and colour of the direction; the second campaign's are hollow.
    const sideOf = (row) => looks.texts.direction[row][k];
    const sides = [...new Set(rows.map(sideOf))].map((side) => [side, rows.filter((row) => sideOf(row) === side)]);
    return [
      areas(`gears ${number}`, bands.flatMap((band) => [...edge(band, 0), ...edge(band, 2).reverse(), null]), { colour, opacity: 0.15 }),
      lines(`gear means ${number}`, bands.flatMap((band) => [...edge(band, 1), null]), { colour }),
      lines(`u ${number}`, bars, { colour, opacity: 0.4 }),
      ...sides.map(([side, own]) => this.marks(`looks ${number} ${side || "unknown"}`, number, own, k,
        { colour: side ? `var(--${side})` : "var(--ink)", glyph: side || "dot", hollow: number > 0 })),
    ];
  }

  show(names, wanted) {
    for (const [number] of this.scenes.all.entries()) {
      for (const name of names) this.all((panel) => panel.show(`${name} ${number}`, wanted));
    }
  }
}

/** One picture of a look, with what was found and what the fit expects. */
class Picture extends Panel {
  below() {
    return (this.images ?? []).map(([source, corner, size]) => {
      const [[x0, y0], [x1, y1]] = [this.at(corner), this.at(corner.map((v, k) => v + size[k]))];
      return node("image", { href: source, x: px(x0), y: px(y0), width: px(x1 - x0), height: px(y1 - y0), preserveAspectRatio: "none" });
    });
  }
}

class Pictures extends Plot {
  constructor(element, scenes) {
    super(element, scenes);
    Object.assign(this, { wide: false, place: null });
  }

  draw() {
    const [width, height] = this.scenes.all[0].image_px;
    const axes = { x: { range: [-0.5, width - 0.5] }, y: { range: [height - 0.5, -0.5] }, equal: true };
    this.panels = this.scenes.sent.cameras.map((title) => new Picture(this.element, { title, ...axes }));
  }

  show(place) {
    this.place = place;
    const { scene, row } = this.scenes.at(place);
    const [width, height] = scene.image_px;
    this.panels.forEach((panel, camera) => {
      const point = (name) => [0, 1].map((k) => scene.looks.at(name, row, 2 * camera + k));
      const [u, v] = point("pixels_px");
      const kept = this.kept(camera);
      const around = Number.isFinite(u + v) && !this.wide;
      panel.seen = around ? [[u - WINDOW_PX, u + WINDOW_PX], [v + WINDOW_PX, v - WINDOW_PX]] : null;
      panel.x = { range: [-0.5, width - 0.5] };
      panel.y = { range: [height - 0.5, -0.5] };
      panel.images = [];
      if (kept) panel.images.push([kept.whole, [-0.5, -0.5], scene.image_px]);
      if (kept?.spot) panel.images.push([kept.spot, kept.corner_px, [kept.side_px, kept.side_px]]);
      const texts = (word, p) => [`${word} ${p.map((value) => value.toFixed(3)).join(", ")} px`];
      const of = (name, word, more) => dots(word, [point(name)], { ...more, hollow: true, places: [place], texts: texts(word, point(name)) });
      panel.put(of("pixels_px", "found", { colour: CHOSEN, glyph: "cross", size: 8 }),
        of("predicted_px", "fitted", { colour: "var(--fitted)", size: 7 }));
    });
  }

  kept(camera) {
    const { scene, row } = this.scenes.at(this.place);
    return scene.pictures[scene.looks.at("spot", row)]?.[this.scenes.sent.cameras[camera]];
  }

  widen(wide) {
    this.wide = wide;
    if (this.place !== null) this.show(this.place);
  }

  remark() {
    if (this.place === null) return "No look is selected.";
    const { scene, row } = this.scenes.at(this.place);
    const [lacking, omitted] = [[], []];
    this.scenes.sent.cameras.forEach((camera, k) => {
      if (!scene.looks.at("pictures", row, k)) lacking.push(camera);
      else if (!this.kept(k)) omitted.push(camera);
    });
    const words = [
      lacking.length ? `No picture of this look is kept (${lacking.join(", ")}).` : "",
      omitted.length ? `Not in this file, or damaged (${omitted.join(", ")}): ${scene.pictured} looks have their pictures here.` : "",
      `Cross: centre found${scene.fitted ? "; ring: where the fitted rig puts it" : ""}. Pictures are reduced; around the spot they are as taken.`,
    ];
    return words.filter(Boolean).join(" ");
  }
}

/** The matrix as squares: red for positive, blue for negative, stronger for more. */
class Matrix extends Panel {
  paths() {
    const { xs, ys } = this.box;
    const inside = (k, [a, b]) => (k + 0.5 - a) * (k - 0.5 - b) < 0 || (k - 0.5 - a) * (k + 0.5 - b) < 0;
    return this.matrix.flatMap((row, i) => row.flatMap((value, j) => {
      if (!inside(j, xs) || !inside(i, ys)) return [];
      const [[x0, y0], [x1, y1]] = [this.at([j - 0.5, i - 0.5]), this.at([j + 0.5, i + 0.5])];
      const fill = value < 0 ? "var(--negative)" : "var(--positive)";
      return [node("rect", { x: px(x0), y: px(y0), width: px(x1 - x0 + 0.3), height: px(y1 - y0 + 0.3), fill, opacity: Math.abs(value) })];
    })).concat(super.paths((p) => this.at(p)));
  }

  cell(point) {
    const [j, i] = this.from(point).map(Math.round);
    return this.matrix[i]?.[j] === undefined ? null : [i, j];
  }

  textAt(point) {
    const cell = this.cell(point);
    return cell && `${this.y.names[cell[0]]} and ${this.x.names[cell[1]]}: ${this.matrix[cell[0]][cell[1]].toFixed(2)}`;
  }

  clicked(point) {
    const cell = this.cell(point);
    if (cell) this.picked(cell.map((k) => this.y.names[k]));
  }
}

class Correlation extends Plot {
  draw() {
    const { names, matrix } = this.scenes.all[0].correlation;
    const panel = new Matrix(this.element, { title: "", x: { names }, y: { names } });
    panel.matrix = matrix;
    panel.picked = (pair) => this.choice(pair);
    this.panels = [panel];
    this.mark([]);
  }

  /** Frame the rows and columns of some parameters, and name what goes with the first most. */
  mark(marked) {
    const { names, matrix } = this.scenes.all[0].correlation;
    const own = marked.map((name) => names.indexOf(name)).filter((k) => k >= 0);
    const [low, high] = [-0.5, names.length - 0.5];
    const frame = (a, b, c, d) => [[a, c], [b, c], [b, d], [a, d], [a, c], null];
    const points = own.flatMap((k) => [...frame(k - 0.5, k + 0.5, low, high), ...frame(low, high, k - 0.5, k + 0.5)]);
    this.panels[0].put(lines("marked", points, { colour: CHOSEN, width: 2 }));
    if (!own.length) return marked.length ? `${marked[0]} is not estimated.` : "";
    const others = matrix[own[0]].map((value, k) => [value, k]).filter(([, k]) => k !== own[0]);
    others.sort((a, b) => Math.abs(b[0]) - Math.abs(a[0]));
    const most = others.slice(0, 3).map(([value, k]) => `${names[k]} ${value.toFixed(2)}`);
    return `${marked[0]} goes most with ${most.join(", ")}.`;
  }
}

class Changes extends Plot {
  draw() {
    const { changes, limit } = this.scenes.sent.changes;
    const names = changes.map((change) => change.quantity);
    const panel = new Panel(this.element, {
      x: { title: "(B - A) / u; dotted: beyond it something has changed (95 %)" }, y: { names },
    });
    const known = changes.map((change, k) => [change.normalised ?? NaN, k, change]);
    const ends = [-limit, limit].flatMap((x) => [[x, -0.5], [x, names.length - 0.5], null]);
    const of = (wanted) => known.filter(([, , change]) => change.significant === wanted).map(([x, k]) => [x, k]);
    panel.put(
      lines("limits", ends, { colour: "var(--quiet)", dash: "2 3" }),
      lines("bars", known.flatMap(([x, k]) => [[x - 1, k], [x + 1, k], null]), { colour: "var(--quiet)" }),
      dots("changes", of(false), { colour: COLOURS[0], size: 4 }), dots("significant", of(true), { colour: CHOSEN, size: 5, glyph: "diamond" }),
    );
    this.panels = [panel];
  }
}
