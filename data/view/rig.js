// The rig in 3D, in parallel projection: cameras, positioner, mirrors, beams, sheets, spots and their error ellipsoids.

const BEAMS_MOST = 300;
const ELLIPSOIDS_MOST = 200;
const CHOSEN_MOST = 300;
const RING = 24;
const MIRROR_HALF_MM = 8;
const DEG = Math.PI / 180;
const DRAG_DEG = 0.4;
/** Size of a label's letter and line. */
const LETTER_PX = 6.5, LINE_PX = 13;
/** Where the eye is, as azimuth from X (depth) towards Y (left) and elevation, degrees. */
const VIEWS = { "from-above": [180, 90], "from-side": [-90, 10], "from-behind": [190, 17] };

/** The vectors of a look's row that holds several. */
const vectorsOf = (looks, name, row) => {
  const numbers = [...looks.row(name, row)];
  return Array.from({ length: numbers.length / 3 }, (_, k) => numbers.slice(3 * k, 3 * k + 3));
};

const wayOf = (looks, row) => [...vectorsOf(looks, "mirrors_mm", row), looks.row("end_mm", row), null];

function ellipsoidOf(looks, row, scale) {
  const [centre, axes] = [looks.row("point_mm", row), looks.row("ellipsoid_mm", row)];
  if (!axes.every(Number.isFinite)) return [];
  return [[0, 1], [1, 2], [2, 0]].flatMap(([a, b]) => {
    const ring = Array.from({ length: RING + 1 }, (_, k) => {
      const [c, s] = [Math.cos((2 * Math.PI * k) / RING), Math.sin((2 * Math.PI * k) / RING)];
      return [0, 1, 2].map((i) => centre[i] + scale * (c * axes[3 * a + i] + s * axes[3 * b + i]));
    });
    return [...ring, null];
  });
}

function mirrorsOf(looks, row) {
  const centres = vectorsOf(looks, "mirrors_mm", row);
  return vectorsOf(looks, "normals", row).flatMap((normal, mirror) => {
    const centre = centres[mirror];
    if (!normal.every(Number.isFinite)) return [];
    // Any two directions in the plane of the mirror.
    const sizes = normal.map(Math.abs);
    const along = cross(normal, [0, 1, 2].map((i) => Number(i === sizes.indexOf(Math.min(...sizes)))));
    const one = along.map((x) => (x * MIRROR_HALF_MM) / Math.hypot(...along));
    const two = cross(normal, one);
    const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]];
    return [...corners.map(([p, q]) => [0, 1, 2].map((i) => centre[i] + p * one[i] + q * two[i])), null];
  });
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

const pyramidOf = ([centre, a, b, c, d]) => [centre, a, b, c, d, a, null, centre, b, null, centre, c, null, centre, d, null];

/** Points in mm seen from an eye at infinity. */
class Space extends Chart {
  constructor(parent, title) {
    super(parent, title);
    Object.assign(this, { labels: [], eye: VIEWS["from-behind"], kept: null, shift: [0, 0] });
  }

  /** Right and upward unit vectors of the picture. */
  base() {
    const [azimuth, elevation] = this.eye.map((angle) => angle * DEG);
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    return [[-sa, ca, 0], [-se * ca, -se * sa, ce]];
  }

  /** The box around all points that stay when sizes are drawn too large: lowest and highest corner. */
  bounds() {
    const corners = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    for (const layer of this.layers) {
      if (layer.enlarged) continue;
      for (const p of layer.points) {
        if (p === null) continue;
        for (let i = 0; i < 3; i++) {
          if (!Number.isFinite(p[i])) continue;
          corners[0][i] = Math.min(corners[0][i], p[i]);
          corners[1][i] = Math.max(corners[1][i], p[i]);
        }
      }
    }
    return corners[0].every(Number.isFinite) ? corners : [[0, 0, 0], [1, 1, 1]];
  }

  parts(width, height) {
    const [right, up] = this.base();
    const [low, high] = this.bounds();
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const flat = (p) => [dot(p, right), -dot(p, up)];
    const corners = Array.from({ length: 8 }, (_, k) => [0, 1, 2].map((i) => ((k >> i) & 1 ? high : low)[i]));
    const ends = corners.map(flat);
    const [xs, ys] = [0, 1].map((k) => [Math.min(...ends.map((p) => p[k])), Math.max(...ends.map((p) => p[k]))]);
    const scale = this.kept ?? 0.82 * Math.min(width / (xs[1] - xs[0]), height / (ys[1] - ys[0]));
    this.scale = scale;
    const middle = [(xs[0] + xs[1]) / 2, (ys[0] + ys[1]) / 2];
    const at = (p) => {
      const q = flat(p);
      return [width / 2 + this.shift[0] + scale * (q[0] - middle[0]), height / 2 + this.shift[1] + scale * (q[1] - middle[1])];
    };
    let box = "";
    for (let k = 0; k < 8; k++) {
      for (const bit of [1, 2, 4]) if (!(k & bit)) box += trail([at(corners[k]), at(corners[k | bit])]);
    }
    const taken = [];
    const words = this.labels.filter(({ point, of }) => point.every(Number.isFinite) && !this.layers.some((layer) => layer.name === of && layer.hidden))
      .map(({ point, text, dy = 16 }) => {
        const [x, y] = at(point);
        const box = { x, y: y + dy, half: LETTER_PX * text.length / 2 };
        // A word that would lie on another one goes below it.
        for (let below; (below = taken.find((one) => Math.abs(one.x - x) < one.half + box.half && Math.abs(one.y - box.y) < LINE_PX)); ) box.y = below.y + LINE_PX;
        taken.push(box);
        return node("text", { x: px(x), y: px(box.y), "text-anchor": "middle", class: "label" }, text);
      });
    return [node("path", { d: box, class: "grid" }), ...this.rulers(low, high, at), ...this.paths(at), ...words];
  }

  /** Values along the edges that begin in the lowest corner. */
  rulers(low, high, at) {
    return ["X depth", "Y left", "Z up"].flatMap((name, i) => {
      const place = (value) => at(low.map((v, k) => (k === i ? value : v)));
      const [a, b] = [place(low[i]), place(high[i])];
      const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
      if (length < 30) return [];
      const made = ticks([low[i], high[i]], length, 70).map(([value, text]) => {
        const [x, y] = place(value);
        return node("text", { x: px(x), y: px(y + 13), "text-anchor": "middle", class: "tick" }, text);
      });
      return [...made, node("text", { x: px(b[0]), y: px(b[1] - 6), "text-anchor": "middle", class: "title" }, name)];
    });
  }

  dragged([dx, dy], _, event) {
    if (event.shiftKey || this.mode === "shift") {
      this.shift = [this.shift[0] + dx, this.shift[1] + dy];
    } else {
      this.kept ??= this.scale;
      this.eye = [this.eye[0] - DRAG_DEG * dx, Math.max(-90, Math.min(90, this.eye[1] + DRAG_DEG * dy))];
    }
    this.draw();
  }

  released() {}

  zoom(factor) {
    this.kept = this.scale * factor;
    this.draw();
  }

  whole() { this.look(this.eye); }

  look(eye) {
    Object.assign(this, { eye, kept: null, shift: [0, 0] });
    this.draw();
  }
}

class Rig extends Plot {
  constructor(element, scenes) {
    super(element, scenes);
    this.scale = 30;
  }

  draw() {
    const space = new Space(this.element, "the rig in 3D");
    this.panels = [space];
    space.picked = (place) => this.choice([place]);
    space.put(...this.scenes.all.flatMap((scene, number) => this.layers(scene, number)));
  }

  layers({ looks, rig }, number) {
    const colour = COLOURS[number];
    const rows = looks.some("point_mm", DOTS_MOST);
    const points = rows.map((row) => looks.row("point_mm", row));
    const places = rows.map((row) => looks.first + row);
    const texts = rows.map((row, k) => `look ${looks.at("spot", row)}: ${[...points[k]].map((v) => v.toFixed(2)).join(", ")} mm`);
    const [first] = looks.some("normals", 1);
    const mirrors = first === undefined ? [] : mirrorsOf(looks, first);
    const origin = rig.origin_mm === null ? [] : [rig.origin_mm];
    const [space] = this.panels;
    for (const { camera, corners_mm: [centre] } of number ? [] : rig.cameras) space.labels.push({ of: "cameras 0", point: centre, text: `${camera} camera`, dy: -8 });
    for (const { target, corners_mm: [, , , corner] } of rig.sheets) space.labels.push({ of: `sheets ${number}`, point: corner, text: `sheet ${target}` });
    for (const point of origin) space.labels.push({ of: `mirrors ${number}`, point, text: "positioner" });
    return [
      areas(`sheets ${number}`, rig.sheets.flatMap((sheet) => [...sheet.corners_mm, null]), { colour, opacity: 0.12 }),
      lines(`cameras ${number}`, rig.cameras.flatMap((camera) => pyramidOf(camera.corners_mm)), { colour: "var(--ink)", width: 1.5, opacity: 0.8 }),
      lines(`beams ${number}`, looks.some("end_mm", BEAMS_MOST).flatMap((row) => wayOf(looks, row)), { colour, width: 0.7, opacity: 0.35 }),
      this.ellipsoids(number),
      lines(`mirrors ${number}`, mirrors, { colour, width: 3 }),
      dots(`positioner ${number}`, origin, { colour, size: 5, glyph: "diamond" }),
      dots(`spots ${number}`, points, { colour, size: looks.count > DOTS_MOST ? 1 : 2, places, texts }),
    ];
  }

  ellipsoids(number) {
    const { looks } = this.scenes.all[number];
    const points = looks.some("ellipsoid_mm", ELLIPSOIDS_MOST).flatMap((row) => ellipsoidOf(looks, row, this.scale));
    return { ...lines(`ellipsoids ${number}`, points, { colour: COLOURS[number], width: 0.7 }), enlarged: true };
  }

  remark() {
    const counts = this.scenes.all.map(({ looks }) => [looks.some("end_mm", Infinity).length, looks.count]);
    const of = (most) => counts.map(([known]) => Math.min(known, most)).join(" and ");
    const known = counts.map(([seen, all]) => `${seen} of ${all}`).join(" and ");
    return `${known} looks have a spot; dots of ${of(DOTS_MOST)}, beams of ${of(BEAMS_MOST)}, ellipsoids (95 %, pixel noise) of at most ` +
      `${ELLIPSOIDS_MOST}, and of what is selected. Drag to turn, with Shift to move; click a spot to select its look.`;
  }

  show(name, wanted) {
    for (const [number] of this.scenes.all.entries()) {
      this.panels[0].show(`${name} ${number}`, wanted);
      if (name === "mirrors") this.panels[0].show(`positioner ${number}`, wanted);
    }
  }

  enlarge(scale) {
    this.scale = scale;
    this.panels[0].put(...this.scenes.all.map((_, number) => this.ellipsoids(number)));
    this.choose(this.places ?? []);
  }

  choose(places) {
    this.places = places;
    const each = (most, of) => some(places, most).flatMap((place) => {
      const { scene: { looks }, row } = this.scenes.at(place);
      return of(looks, row);
    });
    const mirrors = places.length === 1 ? mirrorsOf : () => [];
    this.panels[0].put(
      dots("chosen", each(MARKS_MOST, (looks, row) => [looks.row("point_mm", row)]), { colour: CHOSEN, size: 4, hollow: true }),
      lines("chosen ways", each(CHOSEN_MOST, (looks, row) => [...wayOf(looks, row), ...mirrors(looks, row)]), { colour: CHOSEN, width: 2 }),
      { ...lines("chosen ellipsoids", each(CHOSEN_MOST, (looks, row) => ellipsoidOf(looks, row, this.scale)), { colour: CHOSEN, width: 1.5 }), enlarged: true },
    );
  }

  look(view) { this.panels[0].look(VIEWS[view]); }
}
