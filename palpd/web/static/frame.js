// What every page has: abort, controls, and where the service stands.

import "./abort.js";
import "./controls.js";
import { begin, on } from "./link.js";
import { inButtons, say, unsay } from "./message.js";
import { ask } from "./requests.js";

const state = document.getElementById("state");
const doing = document.getElementById("doing");
const link = document.getElementById("link");
const GONE = "The service does not answer. If the arm moves, use the emergency stop.";
const ASKED = "The set-up waits for an answer in the tab Set-up, and nothing moves. Abort ends it.";
const UNDER_WAY = "A set-up is under way. Abort stops its motion and ends it.";
const OFFERED = "No service answers, and no set-up is under way. If the arm moves, use the emergency stop.";
const LINKS = { connecting: "", open: "", lost: "Link lost", expired: "Page expired" };
let expired = false;
let setup = {};

function show(kind, words, more) {
  document.body.dataset.state = kind;
  if (state.textContent !== words) state.textContent = words; // a screen reader speaks each change
  if (doing.textContent !== more) doing.textContent = more;
}

on("status", ({ now }) => {
  if (document.body.dataset.service === "lost") unsay(); // what was refused while nobody answered
  document.body.dataset.service = "open";
  show(now.state, now.word, inButtons(now.sentence));
});
function showLost() {
  if (setup.under_way) show("running", "Set-up", setup.asked === null ? UNDER_WAY : ASKED);
  else if (setup.offered) show("idle", "No service", OFFERED);
  else show("gone", "No service", GONE);
}
on("lost", () => {
  document.body.dataset.service = "lost";
  showLost();
});
on("setup", (event) => {
  setup = event;
  if (document.body.dataset.service === "lost") showLost();
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
