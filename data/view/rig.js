// The rig in 3D: cameras, positioner, mirrors, beams, sheets, spots and their error ellipsoids.

import { CHOSEN, COLOURS, CONFIG, DOTS_MOST, Lines, MARKS_MOST, some } from "./plots.js";

const BEAMS_MOST = 300;
const ELLIPSOIDS_MOST = 200;
const CHOSEN_MOST = 300;
const RING = 24;
const MIRROR_HALF_MM = 8;
export const VIEWS = {
  "from-above": { eye: { x: 0, y: 0, z: 2.3 }, up: { x: 1, y: 0, z: 0 } },
  "from-side": { eye: { x: 0, y: -1.7, z: 0.3 }, up: { x: 0, y: 0, z: 1 } },
  "from-behind": { eye: { x: -1.6, y: -0.3, z: 0.5 }, up: { x: 0, y: 0, z: 1 } },
};

function addWay(lines, looks, row) {
  lines.add([looks.row("first_mm", row), looks.row("second_mm", row), looks.row("end_mm", row)]);
}

function addEllipsoid(lines, looks, row, scale) {
  const centre = looks.row("point_mm", row);
  const axes = looks.row("ellipsoid_mm", row);
  if (!axes.every(Number.isFinite)) return;
  for (const [a, b] of [[0, 1], [1, 2], [2, 0]]) {
    const ring = [];
    for (let k = 0; k <= RING; k++) {
      const [c, s] = [Math.cos((2 * Math.PI * k) / RING), Math.sin((2 * Math.PI * k) / RING)];
      ring.push([0, 1, 2].map((i) => centre[i] + scale * (c * axes[3 * a + i] + s * axes[3 * b + i])));
    }
    lines.add(ring);
  }
}

function addMirrors(lines, looks, row) {
  for (const which of ["first", "second"]) {
    const centre = looks.row(`${which}_mm`, row);
    const normal = looks.row(`${which}_normal`, row);
    if (!normal.every(Number.isFinite)) continue;
    // Any two directions in the plane of the mirror.
    const least = normal.map(Math.abs).indexOf(Math.min(...normal.map(Math.abs)));
    const along = cross(normal, [0, 1, 2].map((i) => Number(i === least)));
    const length = Math.hypot(...along);
    const one = along.map((x) => (x * MIRROR_HALF_MM) / length);
    const two = cross(normal, one);
    const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]];
    lines.add(corners.map(([p, q]) => [0, 1, 2].map((i) => centre[i] + p * one[i] + q * two[i])));
  }
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function lineTrace(name, lines, colour, width, more = {}) {
  return {
    type: "scatter3d", mode: "lines", name, hoverinfo: "skip", connectgaps: false,
    x: lines.x, y: lines.y, z: lines.z, line: { color: colour, width }, ...more,
  };
}

function cameraLines(cameras) {
  const lines = new Lines(3);
  for (const { corners_mm: [centre, a, b, c, d] } of cameras) {
    lines.add([centre, a, b, c, d, a]);
    for (const corner of [b, c, d]) lines.add([centre, corner]);
  }
  return lines;
}

function sheetTrace(sheet, colour) {
  const [a, b, c, d] = sheet.corners_mm;
  const corners = [a, b, c, d];
  return {
    type: "mesh3d", name: "sheets", hoverinfo: "text", text: `sheet ${sheet.target}`, opacity: 0.15, color: colour,
    x: corners.map((p) => p[0]), y: corners.map((p) => p[1]), z: corners.map((p) => p[2]), i: [0, 0], j: [1, 2], k: [2, 3],
  };
}

/** Traces of one campaign; `names` of them are the switches of the page. */
function sceneTraces(scene, number, scale) {
  const { looks, rig } = scene;
  const colour = COLOURS[number];
  const beams = new Lines(3);
  for (const row of looks.some("end_mm", BEAMS_MOST)) addWay(beams, looks, row);
  const ellipsoids = new Lines(3);
  for (const row of looks.some("ellipsoid_mm", ELLIPSOIDS_MOST)) addEllipsoid(ellipsoids, looks, row, scale);
  const mirrors = new Lines(3);
  const rows = looks.some("point_mm", DOTS_MOST);
  const [first] = looks.some("second_normal", 1);
  if (first !== undefined) addMirrors(mirrors, looks, first);
  const traces = [
    {
      type: "scatter3d", mode: "markers", name: "spots", customdata: rows.map((row) => looks.first + row),
      x: looks.column("point_mm", 0, rows), y: looks.column("point_mm", 1, rows), z: looks.column("point_mm", 2, rows),
      marker: { size: looks.count > DOTS_MOST ? 1.5 : 3, color: colour },
      hovertemplate: "look %{text}<br>%{x:.2f} %{y:.2f} %{z:.2f} mm<extra></extra>", text: looks.column("spot", 0, rows),
    },
    lineTrace("ellipsoids", ellipsoids, colour, 1),
    lineTrace("beams", beams, colour, 1, { opacity: 0.35 }),
    lineTrace("mirrors", mirrors, colour, 5),
    lineTrace("cameras", cameraLines(rig.cameras), "#3b4754", 2),
    ...rig.sheets.map((sheet) => sheetTrace(sheet, colour)),
  ];
  if (rig.origin_mm !== null) {
    const [x, y, z] = rig.origin_mm;
    traces.push({
      type: "scatter3d", mode: "markers+text", name: "mirrors", x: [x], y: [y], z: [z], text: ["positioner"],
      textposition: "bottom center", hoverinfo: "text", marker: { size: 4, symbol: "diamond", color: colour },
    });
  }
  return traces;
}

/** What is chosen, for the last three traces: marks, ways with mirrors, ellipsoids. */
function chosenTraces(scenes, places, scale) {
  const marks = { x: [], y: [], z: [] };
  const ways = new Lines(3);
  const ellipsoids = new Lines(3);
  for (const place of some(places, MARKS_MOST)) {
    const { scene: { looks }, row } = scenes.at(place);
    const point = looks.row("point_mm", row);
    marks.x.push(point[0]);
    marks.y.push(point[1]);
    marks.z.push(point[2]);
  }
  for (const place of some(places, CHOSEN_MOST)) {
    const { scene: { looks }, row } = scenes.at(place);
    addWay(ways, looks, row);
    addEllipsoid(ellipsoids, looks, row, scale);
    if (places.length === 1) addMirrors(ways, looks, row);
  }
  return [
    { type: "scatter3d", mode: "markers", name: "chosen", hoverinfo: "skip", ...marks,
      marker: { size: 5, color: CHOSEN, symbol: "circle-open" } },
    lineTrace("chosen", ways, CHOSEN, 3),
    lineTrace("chosen", ellipsoids, CHOSEN, 2),
  ];
}

function layout(view) {
  const axis = (title) => ({ title: { text: title }, backgroundcolor: "#fff", gridcolor: "#e3e8ec" });
  return {
    margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, uirevision: "kept",
    scene: {
      aspectmode: "data", camera: view,
      xaxis: axis("X depth"), yaxis: axis("Y left"), zaxis: axis("Z up"), dragmode: "orbit",
    },
  };
}

/** The plot in its element: drawn once, then only what changes. */
export class Rig {
  constructor(element, scenes) {
    this.element = element;
    this.scenes = scenes;
    this.scale = 30;
    this.places = [];
  }

  async draw() {
    this.traces = this.scenes.all.flatMap((scene, number) => sceneTraces(scene, number, this.scale));
    const all = [...this.traces, ...chosenTraces(this.scenes, [], this.scale)];
    await Plotly.newPlot(this.element, all, layout(VIEWS["from-behind"]), CONFIG);
  }

  remark() {
    const counts = this.scenes.all.map(({ looks }) => [looks.some("end_mm", Infinity).length, looks.count]);
    const shown = counts.map(([known]) => Math.min(known, BEAMS_MOST)).join(" and ");
    const told = counts.map(([known, all]) => `${known} of ${all}`).join(" and ");
    const dots = counts.map(([known]) => Math.min(known, DOTS_MOST)).join(" and ");
    return `${told} looks have a spot; dots of ${dots}, beams of ${shown}, ellipsoids (95 %, pixel noise) of at most ${ELLIPSOIDS_MOST}, ` +
      "and of what is selected. Click a spot to select its look.";
  }

  show(name, wanted) {
    const own = this.traces.flatMap((trace, k) => (trace.name === name ? [k] : []));
    return Plotly.restyle(this.element, { visible: wanted }, own);
  }

  async enlarge(scale) {
    this.scale = scale;
    for (const [number, scene] of this.scenes.all.entries()) {
      const lines = new Lines(3);
      for (const row of scene.looks.some("ellipsoid_mm", ELLIPSOIDS_MOST)) addEllipsoid(lines, scene.looks, row, scale);
      const own = this.traces.flatMap((trace, k) =>
        trace.name === "ellipsoids" && trace.line.color === COLOURS[number] ? [k] : []);
      await Plotly.restyle(this.element, { x: [lines.x], y: [lines.y], z: [lines.z] }, own);
    }
    await this.choose(this.places);
  }

  choose(places) {
    this.places = places;
    const traces = chosenTraces(this.scenes, places, this.scale);
    const from = this.traces.length;
    const data = { x: traces.map((t) => t.x), y: traces.map((t) => t.y), z: traces.map((t) => t.z) };
    return Plotly.restyle(this.element, data, [from, from + 1, from + 2]);
  }

  look(view) {
    return Plotly.relayout(this.element, { "scene.camera": VIEWS[view] });
  }
}
