// The document's columns as arrays: looks of a campaign, and all looks of all campaigns by one number, their place.

const KINDS = { "<f4": Float32Array, "<i4": Int32Array, u1: Uint8Array };

function unpacked(sent) {
  const text = atob(sent.base64);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  const width = sent.shape.slice(1).reduce((a, b) => a * b, 1);
  return { values: new KINDS[sent.type](bytes.buffer), width };
}

/** The looks of one campaign. */
class Looks {
  constructor(sent, first) {
    this.first = first;
    this.count = sent.spot.shape[0];
    this.texts = { target: sent.target, status: sent.status, direction: sent.direction };
    this.numbers = {};
    for (const [name, value] of Object.entries(sent)) {
      if (value.base64 !== undefined) this.numbers[name] = unpacked(value);
    }
  }

  /** One number of one look. */
  at(name, row, part = 0) {
    const { values, width } = this.numbers[name];
    return values[row * width + part];
  }

  /** All numbers of one look. */
  row(name, row) {
    const { values, width } = this.numbers[name];
    return values.subarray(row * width, (row + 1) * width);
  }

  /** One number of some looks, all by default. */
  column(name, part = 0, rows = null) {
    const { values, width } = this.numbers[name];
    if (rows !== null) return Float32Array.from(rows, (row) => values[row * width + part]);
    const found = new values.constructor(this.count);
    for (let row = 0; row < this.count; row++) found[row] = values[row * width + part];
    return found;
  }

  /** Places of all looks. */
  places() {
    return Int32Array.from({ length: this.count }, (_, row) => this.first + row);
  }

  /** At most so many rows, evenly chosen, among those whose numbers, or one of them, are known. */
  some(name, most, part = null) {
    const known = [];
    for (let row = 0; row < this.count; row++) {
      const finite = part === null ? this.row(name, row).every(Number.isFinite) : Number.isFinite(this.at(name, row, part));
      if (finite) known.push(row);
    }
    if (known.length <= most) return known;
    return Array.from({ length: most }, (_, k) => known[Math.floor((k * known.length) / most)]);
  }
}

/** All campaigns of the document, and their looks by place. */
class Scenes {
  constructor(sent) {
    this.sent = sent;
    let first = 0;
    this.all = sent.scenes.map((scene) => {
      const looks = new Looks(scene.looks, first);
      first += looks.count;
      return { ...scene, looks };
    });
    this.count = first;
  }

  /** The campaign of a place, its number and the row in it. */
  at(place) {
    const number = this.all.findIndex((scene) => place < scene.looks.first + scene.looks.count);
    return { number, scene: this.all[number], row: place - this.all[number].looks.first };
  }

  /** The place of a look by its number in spots.csv; -1 where there is none. */
  placeOf(number, spot) {
    const { looks } = this.all[number];
    const row = looks.numbers.spot.values.indexOf(spot);
    return row < 0 ? -1 : looks.first + row;
  }

  /** Places by campaign: rows of each. */
  rowsBy(places) {
    const found = this.all.map(() => []);
    for (const place of places) {
      const { number, row } = this.at(place);
      found[number].push(row);
    }
    return found;
  }
}
