// SPDX-License-Identifier: Apache-2.0
// Fixed scales, never a scan's own: where a value lies on them, its colour, and how it is written.

// Dark to light, of even steps in lightness ("rocket" of seaborn).
const ANCHORS = [
  "03051a",
  "221331",
  "451c47",
  "691f55",
  "921c5b",
  "b91657",
  "d92847",
  "ed503e",
  "f47d57",
  "f6a47c",
  "f7c9aa",
  "faebdd",
].map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
// Colours between them: more than a screen can show apart.
const STEPS = 256;
const dark = matchMedia("(prefers-color-scheme: dark)");

const RAMP = Array.from({ length: STEPS }, (_, step) => {
  const place = (step / (STEPS - 1)) * (ANCHORS.length - 1);
  const low = Math.min(Math.floor(place), ANCHORS.length - 2);
  return ANCHORS[low].map((from, k) =>
    Math.round(from + (place - low) * (ANCHORS[low + 1][k] - from)),
  );
});
const COLOURS = RAMP.map((rgb) => `rgb(${rgb})`);
// Relative luminance (WCAG 2.2), and whether black is read better than white on a colour: the better
// of them has a contrast of at least 4.58 on any, where lighter and darker meet at sqrt(1.05 * 0.05).
const linear = (part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
const luminance = (rgb) =>
  rgb.reduce((sum, part, k) => sum + [0.2126, 0.7152, 0.0722][k] * linear(part / 255), 0);
const IS_LIGHT = RAMP.map((rgb) => luminance(rgb) > Math.sqrt(1.05 * 0.05) - 0.05);

function step(position) {
  const index = Math.round((STEPS - 1) * Math.min(1, Math.max(0, position)));
  return dark.matches ? index : STEPS - 1 - index; // nothing looks like the page
}

export const colourAt = (position) => COLOURS[step(position)];
export const inkAt = (position) => (IS_LIGHT[step(position)] ? "#000" : "#fff");
export const onTheme = (call) => dark.addEventListener("change", call);

// Three digits, without an exponent.
export function written(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  return value.toFixed(size < 9.995 ? 2 : size < 99.95 ? 1 : 0);
}

// A value and its deviation with the digits that mean something, at most two after the point: the
// deviation has two where they are 10 to 35, otherwise one (Particle Data Group, Introduction, 5.3).
export function writtenWith(value, std) {
  if (!(std > 0) || !Number.isFinite(value + std)) return [written(value), written(std)];
  const size = Math.floor(Math.log10(std));
  const lead = std / 10 ** size;
  const last = Math.max(-2, lead < 3.55 ? size - 1 : size);
  const unit = 10 ** last;
  return [value, Math.max(std, unit)].map((number) =>
    (Math.round(number / unit) * unit).toFixed(Math.max(0, -last)),
  );
}

// The scale of conductances, in siemens: 1 MOhm, about an untouched cell, to 1 kOhm, a hard touch.
const LOW_S = 1e-6;
const HIGH_S = 1e-3;
const DECADES = Math.log10(HIGH_S / LOW_S);
const logPosition = (siemens) => Math.log10(siemens / LOW_S) / DECADES;

// What the page can show. plane: which values of a scan, in SI units. position: where a value lies
// on the scale, 0 to 1. show, std: a value and its deviation in `unit`. floor: values that nothing
// touches are near 0, so a deviation below this, in SI units, does not make them uncertain.
const siemens = {
  name: "conductance",
  unit: "µS",
  plane: "siemens",
  floor: 0.5e-6,
  position: logPosition,
  show: (value) => 1e6 * value,
  std: (_value, std) => 1e6 * std,
  ticks: [1e-6, 1e-5, 1e-4, 1e-3],
};
const ohms = {
  ...siemens,
  name: "resistance",
  unit: "kΩ",
  show: (value) => 1e-3 / value,
  std: (value, std) => (1e-3 * std) / value ** 2,
};
const newtons = (top) => ({
  name: "force",
  unit: "N",
  plane: "force",
  floor: 0.1,
  position: (value) => value / top,
  show: (value) => value,
  std: (_value, std) => std,
  ticks: [0, 0.25, 0.5, 0.75, 1].map((share) => share * top),
});

// How well the cells of a skin that is kneaded are known: the better, the farther up.
const WORST = 0.3;
const known = {
  name: "how well each cell is known",
  unit: "%",
  plane: "log_std",
  floor: 0,
  position: (value) => 1 - value / WORST,
  show: (value) => 100 * value,
  std: () => 0,
  ticks: [0.3, 0.225, 0.15, 0.075, 0],
};

export const TOPS_N = [2, 5, 10, 20, 50];

export function scaleOf(quantity, topN) {
  return { newtons: newtons(topN), ohms, known }[quantity] ?? siemens;
}

// A value that may be none: its deviation is larger. It has a word in place of a number. Cells that
// nothing touches have no force anyway, and values are known well enough below the floor.
export const isUncertain = (scale, value, std, touched) =>
  !(std <= (touched ? value : Math.max(value, scale.floor)));

export const isHatched = (scale, value, std, touched) =>
  !(std <= Math.max(scale.floor, value / 4)) || isUncertain(scale, value, std, touched);

export const isAbove = (scale, value) => scale.position(value) > 1;

export function withStd(scale, value, std, touched) {
  if (isUncertain(scale, value, std, touched)) return "uncertain";
  if (scale === known) return `${written(scale.show(value))} %`;
  const above = isAbove(scale, value) ? ", off the scale" : "";
  const [text, spread] = writtenWith(scale.show(value), scale.std(value, std));
  return `${text} ± ${spread} ${scale.unit}${above}`;
}
