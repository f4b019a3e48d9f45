// The plane plots: pictures of a look, residuals over the images, stops over the counters, correlations, changes.

export const COLOURS = ["#1f6fb2", "#c77a12"];
export const CHOSEN = "#c2185b";
/** Of very many looks so many have a dot, an arrow, a bar: every change of a plot costs time for all it shows. */
export const DOTS_MOST = 3000;
const ARROWS_MOST = 2000;
const BARS_MOST = 1000;
export const MARKS_MOST = 3000;
const MARK_PX = 6;
const WINDOW_PX = 25;
/** Nothing of what Plotly would send elsewhere: its cloud button is on by default. */
export const CONFIG = {
  displaylogo: false, responsive: true, showSendToCloud: false, plotlyServerURL: "", modeBarButtonsToRemove: ["toImage"],
};
const AXES = ["pan", "tilt"];

/** Lines in one trace, with gaps between them. */
export class Lines {
  constructor(dimensions) {
    this.parts = Array.from({ length: dimensions }, () => []);
  }

  add(points) {
    for (const point of points) this.parts.forEach((part, k) => part.push(point[k]));
    for (const part of this.parts) part.push(null);
  }

  get x() { return this.parts[0]; }
  get y() { return this.parts[1]; }
  get z() { return this.parts[2]; }
}

function base(more) {
  return { margin: { l: 60, r: 16, t: 24, b: 40 }, showlegend: false, hovermode: "closest", ...more };
}

const AXIS = { gridcolor: "#e3e8ec", zerolinecolor: "#aeb7bf" };

function titles(words) {
  return words.map((text, k) => ({
    text, showarrow: false, xref: `x${k ? k + 1 : ""} domain`, yref: `y${k ? k + 1 : ""} domain`, x: 0, y: 1,
    xanchor: "left", yanchor: "bottom",
  }));
}

const side = (k) => ({ xaxis: `x${k ? k + 1 : ""}`, yaxis: `y${k ? k + 1 : ""}` });

/** Arrows of residuals, or dots of looks, of some rows; camera 0 or 1. */
function arrows(looks, rows, camera, scale) {
  const lines = new Lines(2);
  for (const row of rows) {
    const [u, v] = [looks.at("pixels_px", row, 2 * camera), looks.at("pixels_px", row, 2 * camera + 1)];
    const [du, dv] = [looks.at("residual_px", row, 2 * camera), looks.at("residual_px", row, 2 * camera + 1)];
    if (Number.isFinite(du + dv)) lines.add([[u, v], [u + scale * du, v + scale * dv]]);
  }
  return lines;
}

/** What both planes share: two plots side by side, each with a dot a look, marks on what is selected. */
class Plane {
  constructor(element, scenes, [x, y]) {
    Object.assign(this, { element, scenes, names: [x, y], places: [] });
  }

  /** Dots of one campaign in one of its plots; `more` has text and what is shown of a dot. */
  dots(number, k, more) {
    const { looks } = this.scenes.all[number];
    const rows = looks.some(this.names[1], DOTS_MOST, this.part(1, k));
    const [x, y] = this.numbers(looks, k, rows);
    return {
      type: "scatter", mode: "markers", name: "looks", ...side(k), x, y, customdata: rows.map((row) => looks.first + row),
      marker: { size: looks.count > DOTS_MOST ? 3 : 5, color: COLOURS[number] },
      selected: { marker: { opacity: 1 } }, unselected: { marker: { opacity: 1 } }, ...more(looks, rows),
    };
  }

  /** Where looks stand in one of the plots; all by default. */
  numbers(looks, k, rows = null) {
    return this.names.map((name, axis) => looks.column(name, this.part(axis, k), rows));
  }

  /** All looks within the frame or lasso that was drawn, also those without a dot. */
  framed(event) {
    const drawn = event?.range ?? event?.lassoPoints;
    if (drawn === undefined) return [];
    const k = "x2" in drawn ? 1 : 0;
    const [xs, ys] = [drawn[k ? "x2" : "x"], drawn[k ? "y2" : "y"]];
    const inside = event.range ? inFrame(xs, ys) : inLasso(xs, ys);
    return this.scenes.all.flatMap(({ looks }) => {
      const [x, y] = this.numbers(looks, k);
      return [...looks.places()].filter((_, row) => inside(x[row], y[row]));
    });
  }

  /** Marks keep their size on the screen. */
  follow() {
    this.element.on("plotly_relayout", (change) => {
      if (Object.keys(change).some((key) => /^[xy]axis/.test(key))) this.choose(this.places);
    });
  }

  choose(places) {
    this.places = places;
    const byScene = this.scenes.rowsBy(some(places, MARKS_MOST));
    return Plotly.relayout(this.element, { shapes: [0, 1].flatMap((k) => this.shapes(byScene, k)) });
  }

  shapes(byScene, k) {
    const [x, y] = [side(k).xaxis, side(k).yaxis];
    const { layout, clientWidth, clientHeight } = this.element;
    const size = (axis, length) => Math.abs(axis.range[1] - axis.range[0]) * MARK_PX / length;
    const across = size(layout[x.replace("x", "xaxis")], 0.42 * clientWidth);
    const down = size(layout[y.replace("y", "yaxis")], 0.75 * clientHeight);
    let path = "";
    byScene.forEach((rows, number) => {
      const [us, vs] = this.numbers(this.scenes.all[number].looks, k, rows);
      us.forEach((u, i) => { if (Number.isFinite(u + vs[i])) path += diamond(u, vs[i], across, down); });
    });
    return path ? [{ type: "path", xref: x, yref: y, path, name: "chosen", line: { color: CHOSEN, width: 2 } }] : [];
  }
}

/** At most so many of a list, evenly chosen. */
export function some(list, most) {
  if (list.length <= most) return list;
  return Array.from({ length: most }, (_, k) => list[Math.floor((k * list.length) / most)]);
}

function diamond(u, v, across, down) {
  return `M${u - across},${v}L${u},${v - down}L${u + across},${v}L${u},${v + down}Z`;
}

function inFrame([x0, x1], [y0, y1]) {
  const within = (value, a, b) => value >= Math.min(a, b) && value <= Math.max(a, b);
  return (x, y) => within(x, x0, x1) && within(y, y0, y1);
}

/** By the number of sides that a ray to the left crosses. */
function inLasso(xs, ys) {
  return (x, y) => {
    let inside = false;
    for (let k = 0, j = xs.length - 1; k < xs.length; j = k++) {
      if ((ys[k] > y) !== (ys[j] > y) && x < ((xs[j] - xs[k]) * (y - ys[k])) / (ys[j] - ys[k]) + xs[k]) inside = !inside;
    }
    return inside;
  };
}

export class Residuals extends Plane {
  constructor(element, scenes) {
    super(element, scenes, ["pixels_px", "pixels_px"]);
    this.scale = 30;
  }

  part(axis, camera) {
    return 2 * camera + axis;
  }

  async draw() {
    const traces = [];
    this.scenes.all.forEach(({ looks }, number) => {
      const rows = looks.some("residual_px", ARROWS_MOST);
      for (const camera of [0, 1]) {
        const lines = arrows(looks, rows, camera, this.scale);
        traces.push(this.dots(number, camera, (own, shown) => ({
          text: own.column("spot", 0, shown), hovertemplate: "look %{text}<br>%{x:.2f}, %{y:.2f} px<extra></extra>",
        })));
        traces.push({
          type: "scatter", mode: "lines", name: "arrows", ...side(camera), hoverinfo: "skip",
          x: lines.x, y: lines.y, line: { color: COLOURS[number], width: 1 }, meta: { number, camera },
        });
      }
    });
    this.traces = traces;
    const [width, height] = this.scenes.all[0].image_px;
    const x = { ...AXIS, range: [-0.5, width - 0.5], title: { text: "u, px" }, constrain: "domain" };
    const y = { ...AXIS, range: [height - 0.5, -0.5], title: { text: "v, px" }, constrain: "domain" };
    await Plotly.newPlot(this.element, traces, base({
      grid: { rows: 1, columns: 2, pattern: "independent" }, dragmode: "select",
      xaxis: x, yaxis: { ...y, scaleanchor: "x" }, xaxis2: x, yaxis2: { ...y, scaleanchor: "x2" },
      annotations: titles(this.scenes.told.cameras),
    }), CONFIG);
    this.follow();
  }

  remark() {
    const dots = this.scenes.all.map(({ looks }) => looks.some("pixels_px", DOTS_MOST).length).join(" and ");
    if (!this.scenes.all.some((scene) => scene.fitted)) {
      return `No residuals without a fit; dots: centres of ${dots} looks. Drag over looks to select them in all plots.`;
    }
    const drawn = this.scenes.all.map(({ looks }) => looks.some("residual_px", ARROWS_MOST).length).join(" and ");
    return `Dots of ${dots} looks, arrows of ${drawn}. Drag over looks to select them, all of them, in all plots.`;
  }

  async enlarge(scale) {
    this.scale = scale;
    for (const [k, trace] of this.traces.entries()) {
      if (trace.name !== "arrows") continue;
      const { looks } = this.scenes.all[trace.meta.number];
      const lines = arrows(looks, looks.some("residual_px", ARROWS_MOST), trace.meta.camera, scale);
      await Plotly.restyle(this.element, { x: [lines.x], y: [lines.y] }, [k]);
    }
    await this.choose(this.places);
  }

  shapes(byScene, camera) {
    const lines = byScene.map((rows, number) => arrows(this.scenes.all[number].looks, rows, camera, this.scale));
    let path = "";
    for (const { x, y } of lines) {
      for (let k = 0; k + 1 < x.length; k += 3) path += `M${x[k]},${y[k]}L${x[k + 1]},${y[k + 1]}`;
    }
    const arrow = { type: "path", xref: side(camera).xaxis, yref: side(camera).yaxis, path, name: "chosen arrows",
      line: { color: CHOSEN, width: 2 } };
    return path ? [...super.shapes(byScene, camera), arrow] : super.shapes(byScene, camera);
  }
}

function bandTraces(band, number) {
  const k = AXES.indexOf(band.axis);
  const [low, mean, high] = band.error_deg;
  const edge = { type: "scatter", mode: "lines", name: "gears", ...side(k), x: band.steps, hoverinfo: "skip" };
  return [
    { ...edge, y: low, line: { width: 0 } },
    { ...edge, y: high, line: { width: 0 }, fill: "tonexty", fillcolor: `${COLOURS[number]}22` },
    { ...edge, y: mean, line: { width: 1, color: COLOURS[number] } },
  ];
}

export class Stops extends Plane {
  constructor(element, scenes) {
    super(element, scenes, ["steps", "deviation_deg"]);
  }

  part(_, k) {
    return k;
  }

  async draw() {
    const traces = [];
    this.scenes.all.forEach(({ looks, gears }, number) => {
      traces.push(...gears.flatMap((band) => bandTraces(band, number)));
      AXES.forEach((axis, k) => {
        const bars = new Lines(2);
        for (const row of looks.some("deviation_deg", BARS_MOST, k)) {
          const [n, off, u] = [looks.at("steps", row, k), looks.at("deviation_deg", row, k), looks.at("u_deg", row, k)];
          bars.add([[n, off - u], [n, off + u]]);
        }
        traces.push({
          type: "scatter", mode: "lines", name: "u", ...side(k), hoverinfo: "skip", x: bars.x, y: bars.y,
          line: { color: COLOURS[number], width: 1 }, opacity: 0.4,
        });
        const came = (own, row) => `look ${own.at("spot", row)}, came ${own.texts.direction[row][k] || "unknown"}`;
        traces.push(this.dots(number, k, (own, shown) => ({
          text: shown.map((row) => came(own, row)), hovertemplate: "%{text}<br>%{x} steps, %{y:.4f} deg<extra></extra>",
        })));
      });
    });
    this.traces = traces;
    const x = { ...AXIS, title: { text: "counter, steps" } };
    const y = { ...AXIS, title: { text: "deviation, deg" } };
    await Plotly.newPlot(this.element, traces, base({
      grid: { rows: 1, columns: 2, pattern: "independent" }, dragmode: "select", xaxis: x, yaxis: y, xaxis2: x, yaxis2: y,
      annotations: titles(AXES),
    }), CONFIG);
    this.follow();
  }

  show(name, wanted) {
    const own = this.traces.flatMap((trace, k) => (trace.name === name ? [k] : []));
    return own.length ? Plotly.restyle(this.element, { visible: wanted }, own) : null;
  }
}

/** Both pictures of one look, with what was found and what the fit expects. */
export class Pictures {
  constructor(element, scenes, fetched) {
    Object.assign(this, { element, scenes, fetched, whole: false, place: null, urls: [] });
  }

  draw() {
    return Plotly.newPlot(this.element, this.traces([[], []], [[], []]), this.layout([null, null]), CONFIG);
  }

  traces(found, expected) {
    return [0, 1].flatMap((camera) => [
      { type: "scatter", mode: "markers", name: "found", ...side(camera), x: found[0][camera], y: found[1][camera],
        marker: { symbol: "cross-thin", size: 16, line: { color: CHOSEN, width: 2 } },
        hovertemplate: "found %{x:.3f}, %{y:.3f} px<extra></extra>" },
      { type: "scatter", mode: "markers", name: "expected", ...side(camera), x: expected[0][camera], y: expected[1][camera],
        marker: { symbol: "circle-open", size: 14, color: "#15a06a", line: { width: 2 } },
        hovertemplate: "fitted %{x:.3f}, %{y:.3f} px<extra></extra>" },
    ]);
  }

  layout(urls) {
    const { scene, row } = this.place === null ? { scene: this.scenes.all[0], row: null } : this.scenes.at(this.place);
    const [width, height] = scene.image_px;
    const images = urls.flatMap((source, camera) => source === null ? [] : [{
      source, xref: side(camera).xaxis, yref: side(camera).yaxis, x: -0.5, y: -0.5, sizex: width, sizey: height,
      xanchor: "left", yanchor: "top", sizing: "stretch", layer: "below",
    }]);
    const ranges = (camera) => {
      const [u, v] = row === null ? [NaN, NaN] : [0, 1].map((k) => scene.looks.at("pixels_px", row, 2 * camera + k));
      if (this.whole || !Number.isFinite(u + v)) return [[-0.5, width - 0.5], [height - 0.5, -0.5]];
      return [[u - WINDOW_PX, u + WINDOW_PX], [v + WINDOW_PX, v - WINDOW_PX]];
    };
    const axes = [0, 1].flatMap((camera) => {
      const [x, y] = ranges(camera);
      const number = camera ? 2 : "";
      const plain = { ...AXIS, showgrid: false, zeroline: false, constrain: "domain" };
      return [[`xaxis${number}`, { ...plain, range: x }], [`yaxis${number}`, { ...plain, range: y, scaleanchor: `x${number}` }]];
    });
    return base({
      grid: { rows: 1, columns: 2, pattern: "independent" }, images, annotations: titles(this.scenes.told.cameras),
      ...Object.fromEntries(axes),
    });
  }

  async show(place) {
    this.place = place;
    const { number, scene, row } = this.scenes.at(place);
    const { looks } = scene;
    const kept = looks.row("pictures", row);
    const urls = await Promise.all(this.scenes.told.cameras.map((camera, k) =>
      kept[k] ? this.fetched(`/picture/${number}/${looks.at("spot", row)}/${camera}`) : null));
    // Another look may have been asked for meanwhile.
    if (this.place !== place) return;
    const of = (name) => [0, 1].map((k) => [0, 1].map((camera) => [looks.at(name, row, 2 * camera + k)]));
    await Plotly.react(this.element, this.traces(of("pixels_px"), of("predicted_px")), this.layout(urls), CONFIG);
    for (const url of this.urls) if (url !== null) URL.revokeObjectURL(url);
    this.urls = urls;
  }

  widen(whole) {
    this.whole = whole;
    return this.place === null ? this.draw() : this.show(this.place);
  }

  remark() {
    if (this.place === null) return "No look is selected.";
    const { scene, row } = this.scenes.at(this.place);
    const kept = scene.looks.row("pictures", row);
    const lacking = this.scenes.told.cameras.filter((_, k) => !kept[k]);
    const told = lacking.length ? `No picture of this look is kept (${lacking.join(", ")}). ` : "";
    return `${told}Cross: centre found${scene.fitted ? "; ring: where the fitted rig puts it" : ""}.`;
  }
}

export class Correlation {
  constructor(element, scenes) {
    Object.assign(this, { element, told: scenes.all[0].correlation });
  }

  async draw() {
    const { names, matrix } = this.told;
    const axis = { tickfont: { size: 8 }, automargin: true, showgrid: false, type: "category" };
    await Plotly.newPlot(this.element, [{
      type: "heatmap", x: names, y: names, z: matrix, zmin: -1, zmax: 1, 
      colorscale: [[0, "#2166ac"], [0.5, "#ffffff"], [1, "#b2182b"]],
      hovertemplate: "%{x}<br>%{y}<br>%{z:.2f}<extra></extra>", colorbar: { thickness: 10 },
    }], base({ xaxis: axis, yaxis: { ...axis, autorange: "reversed" }, shapes: [] }), CONFIG);
  }

  /** Frame the rows and columns of some parameters, and tell what goes with the first most. */
  async mark(names) {
    const own = names.filter((name) => this.told.names.includes(name)).map((name) => this.told.names.indexOf(name));
    const frame = (k, x) => ({
      type: "rect", line: { color: CHOSEN, width: 2 }, xref: x ? "x" : "paper", yref: x ? "paper" : "y",
      x0: x ? k - 0.5 : 0, x1: x ? k + 0.5 : 1, y0: x ? 0 : k - 0.5, y1: x ? 1 : k + 0.5,
    });
    await Plotly.relayout(this.element, { shapes: own.flatMap((k) => [frame(k, true), frame(k, false)]) });
    if (!own.length) return names.length ? `${names[0]} is not estimated.` : "";
    const row = this.told.matrix[own[0]];
    const others = row.map((value, k) => [value, k]).filter(([, k]) => k !== own[0]);
    others.sort((a, b) => Math.abs(b[0]) - Math.abs(a[0]));
    const most = others.slice(0, 3).map(([value, k]) => `${this.told.names[k]} ${value.toFixed(2)}`);
    return `${names[0]} goes most with ${most.join(", ")}.`;
  }
}

export class Changes {
  constructor(element, scenes) {
    Object.assign(this, { element, told: scenes.told.changes });
  }

  draw() {
    const { changes, limit } = this.told;
    const names = changes.map((change) => change.quantity);
    const ends = [-limit, limit].map((x) => ({
      type: "line", xref: "x", yref: "paper", x0: x, x1: x, y0: 0, y1: 1, line: { color: "#5b6875", width: 1, dash: "dot" },
    }));
    return Plotly.newPlot(this.element, [{
      type: "scatter", mode: "markers", y: names, x: changes.map((change) => change.normalised),
      error_x: { type: "constant", value: 1 },
      marker: { size: 9, color: changes.map((change) => (change.significant ? CHOSEN : COLOURS[0])) },
    }], base({
      margin: { l: 220, r: 16, t: 8, b: 40 }, shapes: ends,
      xaxis: { ...AXIS, title: { text: "(B - A) / u; dotted: beyond it something has changed (95 %)" } },
      yaxis: { ...AXIS, autorange: "reversed", type: "category" },
    }), CONFIG);
  }
}
