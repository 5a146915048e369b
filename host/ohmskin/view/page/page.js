// SPDX-License-Identifier: Apache-2.0
// The page: one panel for each board, and the form that opens another.

import { Panel } from "./panel.js";
import { onTheme } from "./scale.js";
import { address } from "./wire.js";

const panels = new Map();
const main = document.getElementById("panels");
const find = (id) => document.getElementById(id);

function show({ number, port }) {
  if (panels.has(number)) return;
  const panel = new Panel(number, port, () => panels.delete(number));
  panels.set(number, panel);
  panel.find(".close").addEventListener("click", async () => {
    panel.close();
    panels.delete(number);
    await ask(`boards/${number}`, { method: "DELETE" });
    find("open").elements.port.focus();
  });
  main.append(panel.element);
}

async function ask(path, request) {
  try {
    const answer = await fetch(address(path), request);
    find("server").textContent = "";
    if (answer.status === 204) return null;
    if (answer.headers.get("content-type") !== "application/json") {
      return { error: await answer.text() };
    }
    return await answer.json();
  } catch {
    find("server").textContent = "'ohmskin view' is out of reach: is it still running?";
    return null;
  }
}

async function open(port) {
  const body = JSON.stringify({ port });
  const answer = await ask("boards", { method: "POST", body });
  find("open-message").textContent = answer?.error ?? "";
  if (answer && !answer.error) {
    show(answer);
    panels.get(answer.number).element.scrollIntoView({ block: "nearest" });
  }
}

async function look() {
  const ports = (await ask("ports")) ?? [];
  const item = document.createElement("li");
  item.textContent = "no serial port: is the board plugged in?";
  find("ports").replaceChildren(...(ports.length ? ports.map(portItem) : [item]));
}

function portItem({ path, description, board }) {
  const item = document.createElement("li");
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = [path, board || description].filter(Boolean).join(" · ");
  button.title = description;
  button.addEventListener("click", () => open(path));
  item.append(button);
  return item;
}

find("open").addEventListener("submit", (event) => {
  event.preventDefault();
  open(event.target.elements.port.value);
});
find("look").addEventListener("click", look);
find("emulator").addEventListener("click", () => open("emulator://8x8?scene=moving"));
onTheme(() => {
  for (const panel of panels.values()) if (panel.state) panel.rescale();
});

function frame(nowMs) {
  for (const panel of panels.values()) panel.frame(nowMs);
  requestAnimationFrame(frame);
}

const boards = await ask("boards");
if (Array.isArray(boards)) boards.forEach(show);
look();
requestAnimationFrame(frame);
