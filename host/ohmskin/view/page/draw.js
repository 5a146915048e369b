// SPDX-License-Identifier: Apache-2.0
// The heat map, its bar and the curve, on canvases that keep to the screen's own pixels.

import { colourAt, inkAt, isAbove, isHatched, isUncertain, written, writtenWith } from "./scale.js";

// Room at the edge of a map, for the numbers of rows and columns [px]. Chosen.
const EDGE_PX = 20;
// Above this, the numbers in the cells would touch each other. They are shown on hover.
const COLUMNS_WITH_NUMBERS = 12;
// Room for what is written beside a contact [px]: "uncertain" is the longest. Chosen.
const AMOUNT_PX = 90;
const FONT = "system-ui, 'DejaVu Sans', sans-serif";

// The context of a canvas of so many CSS pixels, cleared.
export function fit(canvas, width, height) {
  const ratio = devicePixelRatio || 1;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  // Drawn by the processor: so little costs more to bring to a graphics card, or to emulate one.
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return context;
}

export const styleOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

export class HeatMap {
  constructor(map) {
    this.cells = map.querySelector(".cells");
    this.digits = map.querySelector(".digits");
    this.figure = map.parentNode;
    this.width = 0;
    this.texts = [];
    new ResizeObserver(([entry]) => {
      this.width = Math.floor(entry.contentRect.width);
    }).observe(map);
  }

  // Where things are, for this size of skin.
  plan(rows, columns) {
    if (this.rows === rows && this.columns === columns && this.planned === this.width) return;
    [this.rows, this.columns, this.planned] = [rows, columns, this.width];
    this.figure.style.setProperty("--shape", columns / rows); // page.css bounds its width by that
    this.size = Math.max(4, Math.floor((this.width - EDGE_PX) / columns));
    this.texts = [];
    this.height = EDGE_PX + this.size * rows;
    for (const canvas of [this.cells, this.digits]) canvas.style.height = `${this.height}px`;
  }

  at(row, column) {
    return [EDGE_PX + column * this.size, EDGE_PX + row * this.size];
  }

  cellAt(x, y) {
    const row = Math.floor((y - EDGE_PX) / this.size);
    const column = Math.floor((x - EDGE_PX) / this.size);
    const inside = row >= 0 && row < this.rows && column >= 0 && column < this.columns;
    return inside ? row * this.columns + column : null;
  }

  draw(scan, scale, { values, std, touched }, chosen) {
    this.plan(scan.rows, scan.columns);
    const context = fit(this.cells, this.width, this.height);
    const size = this.size;
    for (let cell = 0; cell < values.length; cell++) {
      const [x, y] = this.at(Math.floor(cell / this.columns), cell % this.columns);
      const known = Number.isFinite(values[cell]);
      const position = known ? scale.position(values[cell]) : 0;
      context.fillStyle = known ? colourAt(position) : styleOf("--grid");
      context.fillRect(x, y, size - 1, size - 1);
      if (!known || (std && isHatched(scale, values[cell], std[cell], touched[cell]))) {
        this.hatch(context, x, y, inkAt(position));
      }
      if (isAbove(scale, values[cell])) this.corner(context, x, y, inkAt(position));
      if (touched[cell]) {
        context.strokeStyle = inkAt(position);
        context.lineWidth = 1.5;
        context.strokeRect(x + 2.5, y + 2.5, size - 6, size - 6);
      }
    }
    if (chosen === null) return;
    const [x, y] = this.at(Math.floor(chosen / this.columns), chosen % this.columns);
    context.strokeStyle = styleOf("--accent");
    context.lineWidth = 3;
    context.strokeRect(x - 1, y - 1, size + 1, size + 1);
  }

  // Of a value above the scale, whose colour ends there.
  corner(context, x, y, ink) {
    const [right, side] = [x + this.size - 1, Math.max(3, this.size / 4)];
    context.fillStyle = ink;
    context.beginPath();
    context.moveTo(right - side, y);
    context.lineTo(right, y);
    context.lineTo(right, y + side);
    context.fill();
  }

  hatch(context, x, y, ink) {
    const size = this.size - 1;
    context.save();
    context.beginPath();
    context.rect(x, y, size, size);
    context.clip();
    context.strokeStyle = ink;
    context.globalAlpha = 0.55;
    context.lineWidth = 1;
    context.beginPath();
    for (let at = 6; at < 2 * size; at += 6) {
      context.moveTo(x + at, y);
      context.lineTo(x + at - size, y + size);
    }
    context.stroke();
    context.restore();
  }

  // What is written in the cells: changed less often, because nobody reads sixty a second.
  write(scale, { values, std, touched }) {
    const size = this.size;
    this.texts = [];
    if (size < 28 || this.columns > COLUMNS_WITH_NUMBERS) return;
    this.texts = Array.from(values, (value, cell) => {
      const shown = std && [scale, value, std[cell], touched[cell]];
      if (shown && isUncertain(...shown)) return ["?"];
      if (!shown || size < 42 || !(touched[cell] || isHatched(...shown)))
        return [written(scale.show(value))];
      const [text, spread] = writtenWith(scale.show(value), scale.std(value, std[cell]));
      return [text, `±${spread}`];
    });
  }

  // Numbers of rows and columns, and the texts of the cells in the ink of the colours that are shown.
  drawTexts(scale, { values }) {
    const context = fit(this.digits, this.width, this.height);
    const size = this.size;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.font = `11px ${FONT}`;
    context.fillStyle = styleOf("--soft");
    const every = size < 16 ? 2 : 1;
    for (let row = 0; row < this.rows; row += every) {
      context.fillText(row, EDGE_PX / 2, EDGE_PX + (row + 0.5) * size);
    }
    for (let column = 0; column < this.columns; column += every) {
      context.fillText(column, EDGE_PX + (column + 0.5) * size, EDGE_PX / 2);
    }
    for (const [large, lines] of [
      [size >= 42 ? 13 : 10, 0],
      [10, 1],
    ]) {
      context.font = `${large}px ${FONT}`;
      this.texts.forEach((texts, cell) => {
        if (texts[lines] === undefined) return;
        const [x, y] = this.at(Math.floor(cell / this.columns), cell % this.columns);
        const middle = y + size * (texts.length === 1 ? 0.5 : lines ? 0.72 : 0.4);
        const position = Number.isFinite(values[cell]) ? scale.position(values[cell]) : 0;
        const half = context.measureText(texts[lines]).width / 2 + 1;
        context.fillStyle = colourAt(position); // hatching must not cross a number
        context.fillRect(x + (size - 1) / 2 - half, middle - large / 2, 2 * half, large);
        context.fillStyle = inkAt(position);
        context.fillText(texts[lines], x + (size - 1) / 2, middle);
      });
    }
  }
}

// A circle around each contact, and its force beside it.
export class Touches {
  constructor(list) {
    this.list = list;
    this.items = new Map();
  }

  // texts: of each contact, by its number, in place of those that were given before.
  draw(map, contacts, texts) {
    const ring = Math.max(28, Math.round(1.3 * map.size));
    this.list.style.setProperty("--ring", `${ring}px`);
    for (const [identity, item] of this.items) {
      if (contacts.some((contact) => contact[0] === identity)) continue;
      item.remove();
      this.items.delete(identity);
    }
    contacts.forEach(([identity, row, column], index) => {
      let item = this.items.get(identity);
      if (!item) {
        item = this.list.appendChild(document.createElement("li"));
        item.append(document.createElement("i"), document.createElement("b"));
        this.items.set(identity, item);
      }
      const [x, y] = map.at(row + 0.5, column + 0.5);
      item.style.transform = `translate(${x}px, ${y}px)`;
      item.classList.toggle("left", x + ring / 2 + AMOUNT_PX > map.width);
      if (texts || !item.lastChild.textContent)
        item.lastChild.textContent = (texts ?? [])[index] ?? "";
    });
  }
}

export function drawBar(canvas, scale) {
  const width = canvas.clientWidth;
  const context = fit(canvas, width, 38);
  const [left, right] = [EDGE_PX, width - 26];
  const ramp = context.createLinearGradient(left, 0, right, 0);
  for (let stop = 0; stop <= 1; stop += 1 / 64) ramp.addColorStop(stop, colourAt(stop));
  context.fillStyle = ramp;
  context.fillRect(left, 2, right - left, 12);
  context.strokeStyle = styleOf("--line");
  context.strokeRect(left - 0.5, 1.5, right - left + 1, 13);
  context.fillStyle = styleOf("--soft");
  context.font = `11px ${FONT}`;
  context.textAlign = "center";
  for (const tick of scale.ticks) {
    const x = left + scale.position(tick) * (right - left);
    context.fillRect(x, 15, 1, 4);
    context.fillText(tickText(scale, tick), x, 30);
  }
  context.textAlign = "left";
  context.fillText(scale.unit, right + 5, 12);
}

const tickText = (scale, tick) => String(Number(scale.show(tick).toPrecision(3)));

// Length of the curve of a cell [s]. Chosen.
export const CURVE_S = 10;
// Most scans that are kept for it, whatever their times say. Chosen: 150 a second, more than a
// screen shows.
const SCANS_KEPT = 1500;

// The last ten seconds of all cells, so that another cell's are there when it is chosen.
export class History {
  constructor() {
    this.scans = [];
  }

  add(scan) {
    this.scans.push(scan);
    const oldest = scan.host_time_s - CURVE_S;
    while (this.scans[0].host_time_s < oldest || this.scans.length > SCANS_KEPT) this.scans.shift();
  }

  draw(canvas, scale, cell) {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const context = fit(canvas, width, height);
    const [left, right, top, bottom] = [46, width - 12, 8, height - 32];
    const y = (value) => bottom - Math.min(1, Math.max(0, scale.position(value))) * (bottom - top);
    context.font = `11px ${FONT}`;
    context.textBaseline = "middle";
    const label = (text, x, at, align) => {
      context.textAlign = align;
      context.fillStyle = styleOf("--soft");
      context.fillText(text, x, at);
    };
    context.fillStyle = styleOf("--grid");
    for (const tick of scale.ticks) context.fillRect(left, Math.round(y(tick)), right - left, 1);
    for (const tick of scale.ticks) label(tickText(scale, tick), left - 6, y(tick), "right");
    for (let s = 0; s <= CURVE_S; s += 2) {
      label(s ? `−${s}` : "0", right - (s / CURVE_S) * (right - left), bottom + 12, "center");
    }
    label(scale.unit, 2, bottom + 12, "left");
    label("seconds", (left + right) / 2, height - 6, "center");
    const known = this.scans.filter((scan) => scan[scale.plane]);
    if (!known.length) return;
    const end = this.scans.at(-1).host_time_s;
    const x = (scan) => right - ((end - scan.host_time_s) / CURVE_S) * (right - left);
    const std = `${scale.plane}_std`;
    context.beginPath();
    for (const scan of known) {
      const [value, spread] = [scan[scale.plane][cell], scan[std][cell] || 0];
      context.lineTo(x(scan), y(value + spread));
    }
    for (const scan of known.toReversed()) {
      const [value, spread] = [scan[scale.plane][cell], scan[std][cell] || 0];
      context.lineTo(x(scan), y(Math.max(value - spread, 1e-12)));
    }
    context.fillStyle = styleOf("--band");
    context.fill();
    context.beginPath();
    for (const scan of known) context.lineTo(x(scan), y(scan[scale.plane][cell]));
    context.strokeStyle = styleOf("--accent");
    context.lineWidth = 1.5;
    context.stroke();
    // Where the curve is above the scale: a thick edge, and the highest value in words. Below it is
    // the noise of a cell that nothing touches.
    const above = known.filter((scan) => isAbove(scale, scan[scale.plane][cell]));
    if (!above.length) return;
    context.fillStyle = styleOf("--bad");
    for (const scan of above) context.fillRect(x(scan) - 2, top - 2, 4, 4);
    const highest = Math.max(...above.map((scan) => scan[scale.plane][cell]));
    context.textAlign = "left";
    const text = `above the scale: ${written(scale.show(highest))} ${scale.unit}`;
    context.fillText(text, left + 4, top + 10);
  }
}
