// SPDX-License-Identifier: Apache-2.0
// One board: its controls, its maps, and what is said of it.

import { drawBar, HeatMap, History, Touches } from "./draw.js";
import { scaleOf, TOPS_N, withStd, written, writtenWith } from "./scale.js";
import { Connection } from "./wire.js";

// How often numbers, the table and spoken messages change [ms]: nobody reads sixty a second.
const DIGITS_EVERY_MS = 200;
const TABLE_EVERY_MS = 1000;
const MESSAGE_EVERY_MS = 2000;
const QUANTITIES = {
  newtons: "force (N)",
  siemens: "conductance (µS)",
  ohms: "resistance (kΩ)",
  known: "how well each cell is known (%)",
};
const STATUS = {
  opening: "connecting …",
  scanning: "scanning",
  gone: "not there, tried again every second",
  ended: "ended",
};
const MOVES = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
// Where this browser keeps which parts of a panel are shown.
const SWITCHES = "ohmskin-switches";
// Up to this chi-square a model is said to fit: it is about 1 where it does. Chosen.
const FITS = 3;
// Scans whose latency is shown as their median: a second at 90 Hz.
const LATENCIES = 90;
// Frames that were drawn are counted over this time [ms].
const DRAWN_MS = 2000;

function options(select, names, chosen, text = (name) => name) {
  const wanted = names.map((name) => [String(name), text(name)]);
  const now = [...select.options].map((option) => [option.value, option.text]);
  if (JSON.stringify(wanted) !== JSON.stringify(now)) {
    select.replaceChildren(...wanted.map(([value, label]) => new Option(label, value)));
  }
  if (select.value !== String(chosen)) select.value = chosen;
}

function switches() {
  try {
    return JSON.parse(localStorage.getItem(SWITCHES)) ?? {};
  } catch {
    return {}; // it keeps nothing, or what is no JSON
  }
}

function say(element, text) {
  if (element.textContent !== text) element.textContent = text; // spoken once
}

const median = (values) => values.slice().sort((a, b) => a - b)[values.length >> 1];

export class Panel {
  constructor(number, port, onClosed) {
    this.number = number;
    this.element = document.getElementById("panel").content.cloneNode(true).firstElementChild;
    this.find = (query) => this.element.querySelector(query);
    this.raw = new HeatMap(this.find(".raw .map"));
    this.estimate = new HeatMap(this.find(".estimate .map"));
    this.touches = new Touches(this.find(".touches"));
    this.history = new History();
    this.chosen = null;
    this.quantity = null; // what the user has chosen
    this.topN = 10;
    this.message = "";
    this.latencies = [];
    this.drawnAt = [];
    this.label(port, number);
    this.controls();
    this.enable(false);
    this.connection = new Connection(number, {
      state: (state) => this.take(state),
      notice: (notice) => this.notice(notice),
      scan: (scan) => {
        if (scan.rows !== this.scan?.rows || scan.columns !== this.scan?.columns) {
          this.chosen = null;
          this.history = new History();
        }
        this.history.add(scan);
        this.scan = scan;
        this.element.classList.add("seen");
        this.message = scan.text || this.message; // also of a scan that is not drawn
        this.dirty = true;
      },
      link: (there) => {
        this.element.classList.toggle("lost", !there);
        if (there) return; // its state comes at once
        say(this.find(".status"), "'ohmskin view' is out of reach: trying again");
        this.enable(false);
      },
      closed: () => {
        this.element.remove();
        onClosed(this);
      },
    });
  }

  label(port, number) {
    this.element.style.setProperty("--hue", (210 + 137 * number) % 360); // no two alike side by side
    this.find(".chip").textContent = number + 1;
    const title = this.find("h2");
    title.textContent = port;
    title.id = `panel-${number}`;
    this.element.setAttribute("aria-labelledby", title.id);
    this.find(".controls").setAttribute("aria-label", `Controls of ${port}`);
    this.find(".close").setAttribute("aria-label", `Close ${port}`);
    for (const [name, text] of [
      ["raw", "raw reading"],
      ["estimate", "estimate"],
    ]) {
      const canvas = this.find(`.${name} .cells`);
      canvas.tabIndex = 0;
      canvas.setAttribute("role", "application");
      canvas.setAttribute("aria-roledescription", "heat map");
      canvas.setAttribute(
        "aria-label",
        `Heat map of the ${text}: arrow keys choose a cell, ` +
          "whose value is spoken; the switch 'Table' adds one of all values",
      );
    }
  }

  // ------------------------------------------------------------------------------- controls

  controls() {
    const command = (query, message) => {
      this.find(query).addEventListener("click", () => this.command(message()));
    };
    command(".tare", () => ({ do: "tare", force: false }));
    command(".anyway", () => ({ do: "tare", force: true }));
    command(".undo", () => ({ do: "undo" }));
    command(".record", () => ({ do: this.state?.recording ? "stop" : "record" }));
    command(".focus", () => ({ do: "focus", on: !this.state?.focus }));
    this.find(".mark").addEventListener("submit", (event) => {
      event.preventDefault();
      this.command({ do: "mark", text: event.target.elements.text.value });
      event.target.reset();
    });
    this.find(".method").addEventListener("change", (event) => {
      this.command({ do: "method", method: event.target.value });
    });
    this.find(".quantity").addEventListener("change", (event) => {
      this.quantity = event.target.value;
      this.rescale();
    });
    this.find(".top-n").addEventListener("change", (event) => {
      this.topN = Number(event.target.value);
      this.rescale();
    });
    options(this.find(".top-n"), TOPS_N, this.topN, (top) => `0 to ${top} N`);
    const kept = switches();
    for (const box of this.element.querySelectorAll(".switches input")) {
      box.checked = kept[box.name] === true;
      this.element.classList.toggle(`with-${box.name}`, box.checked);
      box.addEventListener("change", () => this.switch(box));
    }
    for (const map of [this.raw, this.estimate]) {
      map.cells.addEventListener("pointerdown", (event) => {
        const cell = map.cellAt(event.offsetX, event.offsetY);
        if (cell !== null) this.choose(cell);
      });
      map.cells.addEventListener("keydown", (event) => this.move(event));
      map.cells.addEventListener("pointermove", (event) => this.hover(map, event));
      map.cells.addEventListener("pointerleave", () => this.hover(map, null));
    }
  }

  switch({ name, checked }) {
    this.element.classList.toggle(`with-${name}`, checked);
    this.barsMs = this.writtenMs = this.tableMs = 0;
    this.dirty = true;
    try {
      localStorage.setItem(SWITCHES, JSON.stringify({ ...switches(), [name]: checked }));
    } catch {
      // A browser that keeps nothing: it shows the parts until it is closed.
    }
  }

  shows(name) {
    return this.element.classList.contains(`with-${name}`);
  }

  // The value under the pointer: numbers of many columns have no room.
  hover(map, event) {
    const text = map.cells.parentNode.querySelector(".hover");
    const cell = event && this.scan && map.cellAt(event.offsetX, event.offsetY);
    text.hidden = cell === null || cell === undefined;
    map.hovered = text.hidden ? null : cell;
    if (text.hidden) return;
    text.style.left = `${Math.min(event.offsetX + 12, map.width - 90)}px`;
    text.style.top = `${event.offsetY + 14}px`;
    this.sayHovered(map);
  }

  sayHovered(map) {
    if (map.hovered === null || map.hovered === undefined) return;
    const value =
      map === this.estimate
        ? this.value(map.hovered)
        : `${written(this.rawScale.show(this.scan.raw[map.hovered]))} ${this.rawScale.unit}`;
    say(map.cells.parentNode.querySelector(".hover"), `${this.place(map.hovered)}: ${value}`);
  }

  command(message) {
    const anyway = this.find(".anyway");
    if (document.activeElement === anyway) this.find(".tare").focus(); // it goes
    anyway.hidden = true;
    const text = { tare: "taring for a second: let nothing touch the skin" }[message.do] ?? "";
    this.notice({ text, good: true });
    this.connection.say(message);
  }

  move(event) {
    const step = MOVES[event.key];
    if (!step || !this.scan) return;
    event.preventDefault();
    const { rows, columns } = this.scan;
    const row = Math.floor(this.chosen / columns) + step[0];
    const column = (this.chosen % columns) + step[1];
    if (row >= 0 && row < rows && column >= 0 && column < columns)
      this.choose(row * columns + column);
  }

  choose(cell) {
    this.chosen = cell;
    this.dirty = true;
    this.writtenMs = 0;
    if (this.scan) say(this.find(".said"), `cell ${this.place()}: ${this.value()}`);
  }

  // --------------------------------------------------------------------------------- states

  take(state) {
    this.state = state;
    for (const name of Object.keys(STATUS)) {
      this.element.classList.toggle(name, state.status === name);
    }
    this.element.classList.toggle("kneaded", Boolean(state.kneaded));
    if (state.kneaded) say(this.find(".estimate strong"), "How well each cell is known [%]");
    const status = STATUS[state.status];
    say(this.find(".status"), state.text ? `${status}: ${state.text}` : status);
    const board = state.board;
    say(
      this.find(".board"),
      board
        ? `${board.board}, unit ${board.unit_id}, ${board.rows} × ` +
            `${board.columns} cells, firmware ${board.version}` +
            (board.mode === "far" ? ", mode far: lines are sensed at both ends" : "")
        : "",
    );
    options(this.find(".method"), state.methods ?? [], state.method ?? "", (name) =>
      name === state.force_method ? `${name} (calibrated)` : name,
    );
    const recording = this.find(".record");
    recording.textContent = state.recording ? "Stop recording" : "Record";
    recording.setAttribute("aria-pressed", Boolean(state.recording));
    this.element.classList.toggle("recorded", Boolean(state.recording));
    this.find(".focus").setAttribute("aria-pressed", Boolean(state.focus));
    this.enable(true);
    this.sayFile();
    const date = state.rest_date?.slice(0, 19).replace("T", " ");
    say(
      this.find(".rest"),
      !date ? "not known" : `by ${state.tared ? "tare" : "calibration"}\n${date}`,
    );
    say(
      this.find(".advice"),
      date || !board || state.kneaded
        ? ""
        : "Press Tare while nothing touches the skin: light touches show better.",
    );
    if (state.note || this.noted) this.notice({ text: state.note, good: state.kneaded });
    this.noted = Boolean(state.note);
    this.rescale();
  }

  enable(linked) {
    const { status, tared, recording } = this.state ?? {};
    const there = linked && status === "scanning";
    for (const query of [".method", ".tare", ".anyway", ".focus"])
      this.find(query).disabled = !there;
    this.find(".undo").disabled = !there || !tared;
    this.find(".record").disabled = !there && !(linked && recording);
    for (const control of this.find(".mark").elements) control.disabled = !linked || !recording;
  }

  sayFile() {
    const { recording, recorded = "" } = this.state;
    const scans = this.scan?.recorded ?? 0;
    say(
      this.find(".file"),
      recording
        ? `recording to ${recording}: ${scans} scans`
        : recorded && `last recording: ${recorded}`,
    );
  }

  notice({ text, good, refused }) {
    const line = this.find(".notice p");
    line.className = good ? "good" : "bad";
    say(line, text);
    this.find(".anyway").hidden = refused !== "tare";
  }

  rescale() {
    const { force_method, kneaded, method } = this.state;
    const withForce = Boolean(force_method) && method === force_method;
    const there = kneaded
      ? ["known"]
      : ["newtons", "siemens", "ohms"].filter((name) => withForce || name !== "newtons");
    const wanted = there.includes(this.quantity) ? this.quantity : there[0];
    options(this.find(".quantity"), there, wanted, (name) => QUANTITIES[name]);
    this.find(".full-scale").hidden = wanted !== "newtons";
    this.scale = scaleOf(wanted, this.topN);
    this.rawScale = scaleOf(wanted === "newtons" ? "siemens" : wanted, this.topN);
    say(this.find(".amount"), withForce ? "force" : "above rest");
    this.barsMs = this.writtenMs = 0;
    this.dirty = true;
  }

  // -------------------------------------------------------------------------------- drawing

  place(cell = this.chosen) {
    return `(${Math.floor(cell / this.scan.columns)}, ${cell % this.scan.columns})`;
  }

  shownScale() {
    return this.scan[this.scale.plane] ? this.scale : this.rawScale; // the method has just changed
  }

  value(cell = this.chosen) {
    const scale = this.shownScale();
    const [value, std] = [this.scan[scale.plane][cell], this.scan[`${scale.plane}_std`]?.[cell]];
    return withStd(scale, value, std, this.scan.touched[cell]);
  }

  // Called for each frame of the screen.
  frame(nowMs) {
    const scan = this.scan;
    if (!scan || !this.state || this.element.parentNode === null) return;
    const sizes = `${this.raw.width} ${this.estimate.width} ${devicePixelRatio}`;
    if (sizes !== this.sizes)
      [this.sizes, this.dirty, this.writtenMs, this.barsMs] = [sizes, true, 0, 0];
    if (!this.dirty || !this.estimate.width) return;
    this.dirty = false;
    const cells = scan.rows * scan.columns;
    if (this.chosen === null || this.chosen >= cells) {
      this.chosen = scan.siemens?.indexOf(Math.max(...scan.siemens)) ?? 0;
    }
    const scale = this.shownScale();
    const raw = { values: scan.raw, std: null, touched: scan.raw_touched };
    const estimate = {
      values: scan[scale.plane],
      std: scan[`${scale.plane}_std`] ?? null,
      touched: scan.touched,
    };
    // The cell whose curve is shown, or that the keyboard has chosen.
    const focused =
      document.activeElement?.closest(".maps") && this.element.matches(":focus-within");
    const chosen = this.shows("curve") || focused ? this.chosen : null;
    const drawn = [[this.estimate, scale, estimate, ".estimate .bar"]];
    if (this.shows("raw") && this.raw.width)
      drawn.push([this.raw, this.rawScale, raw, ".raw .bar"]);
    const writes = nowMs - (this.writtenMs || 0) >= DIGITS_EVERY_MS || !this.writtenMs;
    for (const [map, itsScale, values, bar] of drawn) {
      map.draw(scan, itsScale, values, chosen);
      const numbers = this.shows("numbers") || this.state.kneaded;
      if (writes && numbers) map.write(itsScale, values);
      if (!numbers) map.texts = [];
      map.drawTexts(itsScale, values);
      if (!this.barsMs) drawBar(this.find(bar), itsScale);
    }
    this.barsMs ||= nowMs;
    this.touches.draw(
      this.estimate,
      scan.contacts,
      writes ? this.amounts(scan, { briefly: true }) : null,
    );
    if (this.shows("curve")) this.history.draw(this.find(".plot"), scale, this.chosen);
    if (writes) {
      this.writtenMs = nowMs;
      this.write(scan, nowMs);
    }
    if (this.shows("table") && nowMs - (this.tableMs || 0) >= TABLE_EVERY_MS) {
      this.tableMs = nowMs;
      this.table(scan, scale);
    }
    this.measure(scan);
  }

  // When this frame is handed to the screen; scans that stay on it are not measured again.
  measure(scan) {
    if (scan === this.measured) return;
    this.measured = scan;
    const channel = new MessageChannel(); // its message comes after the frame, a timer's late
    channel.port1.onmessage = () => {
      const nowMs = performance.now();
      channel.port1.close();
      this.drawnAt.push(nowMs);
      while (this.drawnAt[0] < nowMs - DRAWN_MS) this.drawnAt.shift();
      const latencyMs = nowMs + this.connection.clock.offsetMs - 1000 * scan.host_time_s;
      this.latencies.push(latencyMs);
      if (this.latencies.length > LATENCIES) this.latencies.shift();
      this.element.dispatchEvent(
        new CustomEvent("drawn", {
          detail: { scan: scan.scan, host_time_s: scan.host_time_s, nowMs, latencyMs },
        }),
      );
    };
    channel.port2.postMessage(0);
  }

  // The force of each contact, or how far it is above rest: with its deviation, or briefly.
  amounts({ force, contacts }, { briefly }) {
    if (contacts[0]?.[0] === "next") return ["press here"];
    const [unit, size] = force ? ["N", 1] : ["µS", 1e6];
    return contacts.map(([, , , amount, std]) => {
      if (std === null || !(std <= amount)) return "uncertain"; // null: not known
      const [text, spread] = writtenWith(size * amount, size * std);
      return briefly ? `${text} ${unit}` : `${text} ± ${spread} ${unit}`;
    });
  }

  latency() {
    return this.latencies.length ? `${median(this.latencies).toFixed(0)} ms` : "–";
  }

  health(scan) {
    const missed = scan.missed ? `${scan.missed} scans missed` : "nothing missed";
    const line = `${scan.rate_hz.toFixed(0)} Hz, ${missed}, ${this.latency()}`;
    return scan.wires ? `${line} · ${scan.wires}` : line;
  }

  write(scan, nowMs) {
    const count = (touched) => touched.reduce((sum, each) => sum + each, 0);
    const inWords = this.find(".estimate .count");
    if (this.state.kneaded) {
      say(inWords, `${count(scan.touched)} of ${scan.rows * scan.columns} are known, outlined`);
      this.sayHovered(this.estimate);
      return; // page.css shows nothing else
    }
    say(this.find(".health"), this.health(scan));
    const cells = (number, seem) => `${number} ${number === 1 ? "cell" : "cells"} ${seem}touched`;
    say(this.find(".raw .count"), cells(count(scan.raw_touched), "seemingly "));
    say(inWords, `by ‘${scan.method}’: ${cells(count(scan.touched), "")}`);
    say(this.find(".chosen"), `${this.place()}, the last ten seconds`);
    say(this.find(".value"), this.value());
    this.find(".plot").setAttribute("aria-label", `Curve of cell ${this.place()} over ten seconds`);
    say(this.find(".rate"), `${scan.rate_hz.toFixed(1)} Hz`);
    say(this.find(".missed"), `${scan.missed} scans`);
    say(this.find(".latency"), this.latency());
    say(this.find(".shown"), `${((1000 * this.drawnAt.length) / DRAWN_MS).toFixed(0)} a second`);
    say(this.find(".takes"), `${(1000 * scan.estimate_s).toFixed(1)} ms`);
    const { chi2 } = scan;
    const fit = chi2 === null ? "–" : `${chi2 <= FITS ? "well" : "badly"} (${chi2.toPrecision(2)})`;
    say(this.find(".chi2"), fit);
    if (nowMs - (this.messageMs || 0) >= MESSAGE_EVERY_MS) {
      this.messageMs = nowMs;
      say(this.find(".message"), this.message);
      this.message = "";
    }
    const amounts = this.amounts(scan, { briefly: false });
    const rows = scan.contacts.map(([identity, row, column], index) => [
      identity,
      `${row.toFixed(1)}, ${column.toFixed(1)}`,
      amounts[index],
    ]);
    fill(this.find(".contacts tbody"), rows.length ? rows : [["–", "no contact", ""]]);
    this.sayFile();
    for (const map of [this.raw, this.estimate]) this.sayHovered(map);
  }

  table(scan, scale) {
    const table = this.find(".values table");
    const { rows, columns } = scan;
    const cells = (row) =>
      Array.from({ length: columns }, (_, column) => this.value(row * columns + column));
    const head = ["row", ...Array.from({ length: columns }, (_, column) => `column ${column}`)];
    if (!table.tHead || table.tHead.rows[0].cells.length !== columns + 1) {
      table.replaceChildren(); // else those below are the old ones
      table.createCaption();
      table.createTHead();
      table.createTBody();
      table.tHead.insertRow().append(
        ...head.map((text) => {
          const cell = document.createElement("th");
          cell.scope = "col";
          cell.textContent = text;
          return cell;
        }),
      );
    }
    say(
      table.caption,
      `Estimate of each cell and its standard deviation: ${scale.name} [${scale.unit}], ` +
        "renewed once a second",
    );
    fill(
      table.tBodies[0],
      Array.from({ length: rows }, (_, row) => [row, ...cells(row)]),
    );
  }

  close() {
    this.connection.end();
    this.element.remove();
  }
}

// The rows of a table body; the first cell of each is its heading.
function fill(body, rows) {
  rows.forEach((texts, number) => {
    const row = body.rows[number] ?? body.insertRow();
    texts.forEach((text, column) => {
      let cell = row.cells[column];
      if (!cell) {
        cell = row.appendChild(document.createElement(column ? "td" : "th"));
        if (!column) cell.scope = "row";
      }
      say(cell, String(text));
    });
  });
  while (body.rows.length > rows.length) body.deleteRow(-1);
}
