// What every page has: abort, controls, and where the service stands.

import "./abort.js";
import "./controls.js";
import { begin, on } from "./link.js";
import { say } from "./message.js";
import { ask } from "./requests.js";

const state = document.getElementById("state");
const doing = document.getElementById("doing");
const link = document.getElementById("link");
const STATES = { disarmed: "Disarmed", checking: "Checking the devices", armed: "Armed", running: "Running", waiting: "Waiting for an answer" };
const LINKS = { connecting: "", open: "", lost: "Link lost", expired: "Page expired" };
let expired = false;

function show(kind, words, more) {
  document.body.dataset.state = kind;
  if (state.textContent !== words) state.textContent = words; // a screen reader speaks each change
  if (doing.textContent !== more) doing.textContent = more;
}

on("status", (status) => {
  document.body.dataset.service = "open";
  const paused = status.phase === "paused";
  const kind = paused ? "paused" : status.latched && !status.job ? "latched" : status.state;
  const words = paused ? "Paused" : kind === "latched" ? "Stopped" : STATES[status.state] ?? status.state;
  const not_ready = status.cell && !status.cell.ready ? `not ready: ${status.cell.reason}` : "";
  const pressed = status.probe?.state === "pressed" && !status.job ? "The probe is pressed" : "";
  show(kind, words, status.activity ?? status.active?.activity ?? [pressed, status.latched || not_ready].filter(Boolean).join("; "));
});
on("lost", ({ reason }) => {
  document.body.dataset.service = "lost";
  show("gone", "No service", reason);
});
on("refused", ({ reason }) => say(reason, "refused"));
on("link", (now) => {
  if (now === "open") expired = false; // the token was given in another tab
  link.textContent = expired ? LINKS.expired : LINKS[now];
});
on("closed", async () => {
  if (expired) return;
  const answer = await ask("/do/status", {}, { patience_ms: 1000 });
  if (answer.expired) {
    expired = true;
    link.textContent = LINKS.expired;
    say(answer.error, "refused");
  }
});

if (document.body.dataset.page === "entrance") show("gone", "Not open", "");
else document.addEventListener("DOMContentLoaded", begin); // once the page's own module listens too: the first status comes but once
