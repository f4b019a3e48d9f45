// Charts as SVG: planes with axes that are zoomed, moved and selected in; layers of dots, lines, areas; a chart as a file.
// Classic scripts without modules: the page of a campaign is one file, and a browser loads no module from a file.

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 64, right: 12, top: 24, bottom: 42 };
const PICK_PX = 12;
const CLICK_PX = 4;
const ZOOM = 1.4;
/** Width of a letter of a name beside an axis. */
const NAME_PX = 5.6;

const by = (id) => document.getElementById(id);

function node(name, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

/** Never minus zero; with two digits of the uncertainty, by a power of ten where it is very small. */
function digits(value, sd) {
  if (!Number.isFinite(value)) return "";
  if (!(sd > 0)) return String(Number(value.toPrecision(6)));
  const places = 1 - Math.floor(Math.log10(sd));
  const text = places > 6
    ? value.toExponential(Math.max(0, places + Math.floor(Math.log10(Math.abs(value) || sd))))
    : value.toFixed(Math.max(0, places));
  return Number(text) === 0 ? text.replace("-", "") : text;
}

const px = (value) => value.toFixed(1);
const GLYPHS = {
  dot: (x, y, r) => `M${px(x - r)} ${px(y)}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0z`,
  left: (x, y, r) => `M${px(x - 1.3 * r)} ${px(y)}l${2.2 * r} ${-1.2 * r}v${2.4 * r}z`,
  right: (x, y, r) => `M${px(x + 1.3 * r)} ${px(y)}l${-2.2 * r} ${-1.2 * r}v${2.4 * r}z`,
  up: (x, y, r) => `M${px(x)} ${px(y - 1.3 * r)}l${1.2 * r} ${2.2 * r}h${-2.4 * r}z`,
  down: (x, y, r) => `M${px(x)} ${px(y + 1.3 * r)}l${1.2 * r} ${-2.2 * r}h${-2.4 * r}z`,
  diamond: (x, y, r) => `M${px(x - r)} ${px(y)}l${r} ${-r}l${r} ${r}l${-r} ${r}z`,
  cross: (x, y, r) => `M${px(x - r)} ${px(y)}h${2 * r}M${px(x)} ${px(y - r)}v${2 * r}`,
};

/** A mark at every point; `places` and `texts` say what is picked there and what a pointer over it shows. */
function dots(name, points, { colour, size = 3, glyph = "dot", hollow = false, places = [], texts = null, opacity = 1 }) {
  const look = hollow ? { fill: "none", stroke: colour, "stroke-width": 1.6 } : { fill: colour };
  const path = (at) => at.map((p) => (p === null ? "" : GLYPHS[glyph](p[0], p[1], size))).join("");
  return { name, points, places, texts, path, attributes: { ...look, opacity } };
}

/** Lines through points, with a gap at every null. */
function lines(name, points, { colour, width = 1, opacity = 1, dash = "none" }) {
  const attributes = { fill: "none", stroke: colour, "stroke-width": width, "stroke-dasharray": dash, opacity };
  return { name, points, path: trail, attributes };
}

/** Areas between points, one after every null. */
function areas(name, points, { colour, opacity }) {
  return { name, points, path: trail, attributes: { fill: colour, opacity } };
}

function trail(at) {
  let path = "";
  let pen = "M";
  for (const p of at) {
    if (p !== null) path += `${pen}${px(p[0])} ${px(p[1])}`;
    pen = p === null ? "M" : "L";
  }
  return path;
}

/** Round values inside a range, about one in so many pixels. */
function ticks([low, high], length, spacing) {
  const span = Math.abs(high - low);
  const rough = span / Math.max(2, length / spacing);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((one) => one * power >= rough) ?? 10);
  const places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const first = Math.ceil(Math.min(low, high) / step);
  const found = [];
  for (let k = first; k * step <= Math.max(low, high) && found.length < 100; k++) found.push([k * step, (k * step).toFixed(places)]);
  return found;
}

const HINT = document.createElement("div");
HINT.className = "hint";
HINT.hidden = true;

function hint(event, text) {
  HINT.hidden = !text;
  if (!text) return;
  if (!HINT.isConnected) document.body.append(HINT);
  HINT.textContent = text;
  HINT.style.left = `${Math.min(event.clientX + 14, innerWidth - HINT.offsetWidth - 4)}px`;
  HINT.style.top = `${Math.max(4, event.clientY - HINT.offsetHeight - 10)}px`;
}

/** What all charts share: an SVG as large as its place, layers by name, a pointer that picks, hovers and drags. */
class Chart {
  constructor(parent, title) {
    this.svg = parent.appendChild(node("svg", { class: "chart", role: "img", "aria-label": title }));
    Object.assign(this, { title, layers: [], picks: [], mode: "move", picked: () => {}, selected: () => {} });
    this.listen();
    new ResizeObserver(() => this.draw()).observe(this.svg);
  }

  /** Put layers in the place of those with their names, or after all others. */
  put(...layers) {
    const names = new Set(layers.map((layer) => layer.name));
    const hidden = new Set(this.layers.filter((layer) => layer.hidden).map((layer) => layer.name));
    for (const layer of layers) layer.hidden = hidden.has(layer.name);
    const first = this.layers.findIndex((layer) => names.has(layer.name));
    const others = this.layers.filter((layer) => !names.has(layer.name));
    others.splice(first < 0 ? others.length : first, 0, ...layers);
    this.layers = others;
    this.draw();
  }

  show(name, wanted) {
    for (const layer of this.layers) if (layer.name === name) layer.hidden = !wanted;
    this.draw();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.svg;
    if (!width || !height) return;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.picks = [];
    this.svg.replaceChildren(...this.parts(width, height));
  }

  /** The paths of the layers; `at` is where a point lies in the picture. */
  paths(at) {
    return this.layers.filter((layer) => !layer.hidden).map((layer) => {
      const points = layer.points.map((p) => (p === null || !p.every(Number.isFinite) ? null : at(p)));
      layer.places?.forEach((place, k) => { if (points[k] !== null) this.picks.push([points[k], place, layer.texts?.[k]]); });
      const count = points.filter((p) => p !== null).length;
      return node("path", { ...layer.attributes, d: layer.path(points), "data-name": layer.name, "data-count": count });
    });
  }

  nearest([x, y]) {
    let best = null;
    let least = PICK_PX;
    for (const pick of this.picks) {
      const far = Math.hypot(pick[0][0] - x, pick[0][1] - y);
      if (far < least) [best, least] = [pick, far];
    }
    return best;
  }

  where(event) {
    const box = this.svg.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  listen() {
    const { svg } = this;
    let way = null;
    svg.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      svg.setPointerCapture(event.pointerId);
      way = [this.where(event)];
    });
    svg.addEventListener("pointermove", (event) => {
      const now = this.where(event);
      if (way === null) return hint(event, this.textAt(now));
      const last = way.at(-1);
      way.push(now);
      this.dragged([now[0] - last[0], now[1] - last[1]], way, event);
    });
    svg.addEventListener("pointerup", (event) => {
      if (way === null) return;
      const done = way;
      way = null;
      const [[x0, y0], [x1, y1]] = [done[0], this.where(event)];
      if (done.every(([x, y]) => Math.hypot(x - x0, y - y0) < CLICK_PX)) this.clicked([x1, y1]);
      else this.released([...done, [x1, y1]]);
    });
    svg.addEventListener("pointercancel", () => { way = null; this.draw(); });
    svg.addEventListener("pointerleave", (event) => hint(event, ""));
    svg.addEventListener("dblclick", () => this.whole());
    svg.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? ZOOM : 1 / ZOOM, this.where(event));
    }, { passive: false });
  }

  textAt(point) { return this.nearest(point)?.[2] ?? ""; }

  clicked(point) {
    const pick = this.nearest(point);
    if (pick !== null) this.picked(pick[1]);
  }
}

/** A plane with two axes; an axis has a title, and a range (from left to right, from below upwards) or names. */
class Panel extends Chart {
  constructor(parent, { title = "", x, y, equal = false }) {
    super(parent, title);
    Object.assign(this, { x, y, equal, seen: null });
  }

  reach(axis, k) {
    if (axis.range) return axis.range;
    if (axis.names) return k ? [axis.names.length - 0.5, -0.5] : [-0.5, axis.names.length - 0.5];
    let [low, high] = [Infinity, -Infinity];
    for (const { points } of this.layers) {
      for (const p of points) {
        if (p === null || !Number.isFinite(p[k])) continue;
        low = Math.min(low, p[k]);
        high = Math.max(high, p[k]);
      }
    }
    if (low > high) return [0, 1];
    const margin = 0.05 * (high - low) || 0.05 * Math.abs(high) || 1;
    return [axis.fromZero ? 0 : low - margin, high + margin];
  }

  parts(width, height) {
    const [xs, ys] = this.seen ?? [this.reach(this.x, 0), this.reach(this.y, 1)];
    const longest = (axis) => NAME_PX * Math.max(...axis.names.map((name) => name.length));
    const left = this.y.names ? Math.min(longest(this.y) + 12, 0.5 * width) : MARGIN.left;
    // Names below that would lie on each other are left out: such a plot has the same ones at its left.
    const below = this.x.names && (width - left) / this.x.names.length >= 8;
    const bottom = below ? longest(this.x) + 8 : MARGIN.bottom;
    let [w, h] = [width - left - MARGIN.right, height - MARGIN.top - bottom];
    if (this.equal) {
      const scale = Math.min(w / Math.abs(xs[1] - xs[0]), h / Math.abs(ys[1] - ys[0]));
      [w, h] = [scale * Math.abs(xs[1] - xs[0]), scale * Math.abs(ys[1] - ys[0])];
    }
    this.box = { left, top: MARGIN.top, w, h, xs, ys, below };
    const clip = `clip-${this.number ??= ++Panel.count}`;
    const kept = node("clipPath", { id: clip });
    const frame = { x: left, y: MARGIN.top, width: w, height: h };
    kept.append(node("rect", frame));
    const inside = node("g", { "clip-path": `url(#${clip})` });
    inside.append(...this.below(), ...this.paths((p) => this.at(p)));
    this.mark = node("path", { class: "frame" });
    return [kept, node("rect", { ...frame, class: "plane" }), ...this.axes(), inside, this.mark,
      node("text", { x: left, y: MARGIN.top - 8, class: "title" }, this.title)];
  }

  at([x, y]) {
    const { left, top, w, h, xs, ys } = this.box;
    return [left + ((x - xs[0]) / (xs[1] - xs[0])) * w, top + h - ((y - ys[0]) / (ys[1] - ys[0])) * h];
  }

  from([px, py]) {
    const { left, top, w, h, xs, ys } = this.box;
    return [xs[0] + ((px - left) / w) * (xs[1] - xs[0]), ys[0] + ((top + h - py) / h) * (ys[1] - ys[0])];
  }

  /** What lies below the layers. */
  below() { return []; }

  axes() {
    const { left, top, w, h, xs, ys, below } = this.box;
    const made = [];
    let grid = "";
    const named = (axis, range) => axis.names.map((name, k) => [k, name]).filter(([k]) => (k - range[0]) * (k - range[1]) <= 0);
    for (const [value, text] of this.x.names ? named(below ? this.x : { names: [] }, xs) : ticks(xs, w, 90)) {
      const [at] = this.at([value, ys[0]]);
      if (!this.x.names) grid += `M${px(at)} ${top}v${px(h)}`;
      const turned = this.x.names ? { transform: `rotate(-90 ${px(at)} ${px(top + h + 6)})`, dy: "0.3em", class: "name" } : { dy: "0.8em" };
      made.push(node("text", { x: px(at), y: px(top + h + 6), "text-anchor": this.x.names ? "end" : "middle", ...turned }, text));
    }
    for (const [value, text] of this.y.names ? named(this.y, ys) : ticks(ys, h, 35)) {
      const at = this.at([xs[0], value])[1];
      if (!this.y.names) grid += `M${left} ${px(at)}h${px(w)}`;
      made.push(node("text", { x: left - 6, y: px(at), dy: "0.35em", "text-anchor": "end", class: this.y.names ? "name" : "" }, text));
    }
    const titles = [
      node("text", { x: px(left + w / 2), y: px(top + h + 36), "text-anchor": "middle" }, this.x.title ?? ""),
      node("text", { transform: `translate(12 ${px(top + h / 2)}) rotate(-90)`, "text-anchor": "middle" }, this.y.title ?? ""),
    ];
    return [node("path", { d: grid, class: "grid" }), ...made, ...titles];
  }

  dragged([dx, dy], way) {
    if (this.mode === "move") {
      const [a, b] = [this.from([0, 0]), this.from([dx, dy])];
      const { xs, ys } = this.box;
      this.seen = [xs.map((v) => v - b[0] + a[0]), ys.map((v) => v - b[1] + a[1])];
      return this.draw();
    }
    const [[x0, y0], [x1, y1]] = [way[0], way.at(-1)];
    const frame = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
    this.mark.setAttribute("d", `${trail(this.mode === "lasso" ? way : frame)}z`);
    return null;
  }

  /** What was framed is handed on as a test of a point. */
  released(way) {
    this.mark.setAttribute("d", "");
    if (this.mode === "move") return;
    const drawn = way.map((p) => this.from(p));
    this.selected(this.mode === "lasso" ? inLasso(drawn) : inFrame(drawn[0], drawn.at(-1)));
  }

  zoom(factor, about = null) {
    const { left, top, w, h, xs, ys } = this.box;
    const middle = this.from(about ?? [left + w / 2, top + h / 2]);
    this.seen = [xs, ys].map((range, k) => range.map((v) => middle[k] + (v - middle[k]) / factor));
    this.draw();
  }

  whole() {
    this.seen = null;
    this.draw();
  }
}
Panel.count = 0;

function inFrame([x0, y0], [x1, y1]) {
  const within = (value, a, b) => value >= Math.min(a, b) && value <= Math.max(a, b);
  return (x, y) => within(x, x0, x1) && within(y, y0, y1);
}

/** By the number of sides that a ray to the left crosses. */
function inLasso(corners) {
  return (x, y) => {
    let inside = false;
    corners.forEach(([xk, yk], k) => {
      const [xj, yj] = corners.at(k - 1);
      if ((yk > y) !== (yj > y) && x < ((xj - xk) * (y - yk)) / (yj - yk) + xk) inside = !inside;
    });
    return inside;
  };
}

const STYLED = ["fill", "stroke", "stroke-width", "stroke-dasharray", "opacity", "font-size", "font-weight", "font-family", "text-anchor", "image-rendering"];

/** All charts in an element as one SVG document, with the colours that they have now. */
function asDocument(element) {
  const outer = element.getBoundingClientRect();
  const whole = node("svg", { xmlns: SVG, width: outer.width, height: outer.height });
  whole.append(node("rect", { width: "100%", height: "100%", fill: getComputedStyle(element.closest("figure")).backgroundColor }));
  for (const chart of element.querySelectorAll("svg.chart")) {
    const box = chart.getBoundingClientRect();
    const copy = chart.cloneNode(true);
    for (const [key, value] of Object.entries({ x: box.left - outer.left, y: box.top - outer.top, width: box.width, height: box.height })) {
      copy.setAttribute(key, value);
    }
    const copies = copy.querySelectorAll("*");
    chart.querySelectorAll("*").forEach((one, k) => {
      const style = getComputedStyle(one);
      for (const name of STYLED) copies[k].setAttribute(name, style.getPropertyValue(name));
      copies[k].removeAttribute("class");
    });
    whole.append(copy);
  }
  return new XMLSerializer().serializeToString(whole);
}

/** Saves the charts of an element as SVG or PNG. */
async function save(element, name, format) {
  const text = asDocument(element);
  let blob = new Blob([text], { type: "image/svg+xml" });
  if (format === "png") {
    const image = new Image();
    image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [2 * image.width, 2 * image.height];
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    blob = await new Promise((made) => canvas.toBlob(made));
  }
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `${name}.${format}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
