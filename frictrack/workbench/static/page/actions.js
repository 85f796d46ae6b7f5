// What the user can do. Every action shows at once that it is under way; changes are sent one after the other, each with the
// newest revision that this tab knows, so that a change made elsewhere is never overwritten unseen.

import { getJSON, post, request } from "./api.js";
import { receive } from "./live.js";
import { mark, say, selectedRun, store, update, watch } from "./store.js";

let queue = Promise.resolve();
let revision = 0; // after the last change of this tab
let refused = 0; // tasks that failed

const seen = () => Math.max(revision, store.study?.revision ?? 0);

/** Run one task after all earlier ones; resolves to whether it succeeded. */
function inTurn(key, task) {
  mark(key, true);
  const mine = queue.then(task).then(
    () => true,
    (error) => ((refused += 1), say(error.message, "bad"), error.status === 409 && readAgain(), false),
  );
  queue = mine;
  return mine.finally(() => mark(key, false));
}

/** Wait until all changes of this tab are written and shown, also those that come while it waits; resolves to whether none was
 *  refused. */
async function settled() {
  const before = refused;
  for (let last = null; last !== queue; ) {
    last = queue;
    await last;
  }
  return refused === before;
}

/** Wait for changes of the study that are under way, as of a box that has just lost the focus; resolves to whether there were any. */
export async function edited() {
  const some = [...store.busy].some((key) => /^(edit\.|draft\.|takeIn$)/.test(key));
  return some && (await settled(), true);
}

/** Read the state now instead of waiting for the server to send it. */
export const refresh = async () => receive(await getJSON("/api/state"));

/** Read the state after a change that was refused: what this tab knew is wrong. */
function readAgain() {
  revision = 0;
  return refresh();
}

/** A quick change of the study; it has ended when the page shows the study with it. */
export function change(name, args, words, key = name) {
  return inTurn(key, async () => {
    const made = await post("/api/do", { do: name, arguments: args, seen: seen() });
    if (made.revision !== undefined) revision = made.revision;
    say(words || made.words || "Done.");
    await refresh();
  });
}

/** Text of a field as the value of a key: a number if it is one, null if it is empty. */
export function valueOf(text) {
  const plain = text.trim();
  if (!plain) return null;
  return Number.isFinite(Number(plain)) ? Number(plain) : plain;
}

/** Write one key of the study file. */
export const edit = (table, key, value, which, words, busy) =>
  change("edit", { table, key, value, ...(which ? { which } : {}) }, words, busy || `edit.${table}.${which || ""}.${key}`);

/** Start a job; `words` say what it will do. */
export function start(name, args = {}, words = name) {
  update({ starting: { do: name, words, arguments: args, at: Date.now() }, notice: null });
  return inTurn(`job.${name}`, async () => {
    try {
      const { job } = await post("/api/job", { do: name, arguments: args, seen: seen() });
      const { study } = store, ended = study?.last_job?.id === job?.id; // a quick one ends before this answer arrives
      if (ended) update({ starting: null });
      else if (job && study && !study.job) update({ study: { ...study, job } });
    } catch (error) {
      update({ starting: null });
      throw error;
    }
  });
}

export const cancel = () => inTurn("cancel", () => post("/api/cancel"));

/** Run everything and go to the comparison; without what is needed say what is missing. */
export async function runAll() {
  if (store.busy.has("run")) return;
  mark("run", true);
  const written = await settled(); // what was typed last
  mark("run", false);
  if (!written) return; // the banner says why
  const { ready, exists } = store.study || {};
  if (!exists || !ready.can_run) {
    say(exists ? ready.words : "Choose recordings or open the sample study first.", "warn");
    document.querySelector(exists ? '.ui-field[data-missing="true"] input' : ".ui-folder > button")?.focus();
    return;
  }
  update({ tab: "compare", tried: "", shown: "", perRun: false });
  start("run", {}, "Run");
}

/** Bring an outdated result up to date. */
export const renew = ({ do: name, arguments: args = {} }, words = "Update") =>
  name === "run" ? runAll() : start(name, args, words);

/** Undo or redo the last change, and say what it was. */
async function step(name, done) {
  await edited();
  const { [`can_${name}`]: can, [`${name}_words`]: words } = store.study?.history || {};
  return can && change(name, {}, `${done}: ${words.replace(/^\w+: /, "")}.`);
}

export const undo = () => step("undo", "Undone");
export const redo = () => step("redo", "Redone");

/** Add a candidate and diagnose again. */
export function addEffect(effect) {
  update({ tried: "", shown: "" });
  return start("add_and_diagnose", { effect }, `Add ${effect}`);
}

export const removeEffect = (effect) => start("remove_and_diagnose", { effect }, `Remove ${effect}`);

const TABLE_OF = { mass: "study", fps: "camera", scale: "camera" };
const NOTHING = { mass: "", fps: "", scale: "" };

/** Write what was typed before there was a study, as soon as there is one; it is shown until the study has it. */
watch(() => {
  if (!store.study?.exists || store.busy.has("takeIn")) return;
  for (const [key, text] of Object.entries(store.draft)) {
    if (text && !store.busy.has(`draft.${key}`)) writeDraft(key, text);
  }
});

async function writeDraft(key, text) {
  mark(`draft.${key}`, true);
  await edit(TABLE_OF[key], key, valueOf(text));
  update({ draft: { ...store.draft, [key]: "" } });
  mark(`draft.${key}`, false);
}

/** Make a study of some recordings, or take them into the study. */
export function takeIn(recordings) {
  return inTurn("takeIn", async () => {
    const sent = store.draft;
    const fields = Object.fromEntries(Object.entries(sent).filter(([, text]) => text));
    await post("/api/study", { recordings, fields });
    const late = Object.entries(store.draft).filter(([key, text]) => text !== sent[key]); // typed while the study was written
    update({ draft: { ...NOTHING, ...Object.fromEntries(late) }, tab: "film" });
    await refresh();
    say(`${recordings.length === 1 ? recordings[0] : `${recordings.length} recordings`} in the study.`);
  });
}

/** Copy the sample films and open their study. */
export const openSample = () =>
  inTurn("sample", async () => {
    await post("/api/sample");
    await refresh();
    update({ tab: "film" });
    say("The sample study is open. Press Run.");
  });

/** Store dropped files in the folder of the study, then take them in. */
export function upload(files) {
  return inTurn("upload", async () => {
    const names = [];
    for (const [k, file] of files.entries()) {
      say(`Copying ${file.name} (${k + 1} of ${files.length}) ...`);
      const answer = await request(`/api/upload?name=${encodeURIComponent(file.name)}`, { body: file });
      names.push((await answer.json()).name);
    }
    await refresh();
    say(`${names.join(", ")}: stored beside the study.`);
    const taken = new Set(store.study.recordings.filter((one) => one.in_study).map((one) => one.name));
    const fresh = names.filter((name) => !taken.has(name));
    if (fresh.length) setTimeout(() => takeIn(fresh));
  });
}

/** Write what was drawn on the film into the study. */
export function writeShape({ tool, shape }) {
  const run = selectedRun();
  if (!run) return say("Use the recording first; then draw on it.", "warn");
  if (tool === "ruler") return update({ drawn: shape, tool: "" });
  update({ tool: "" });
  const areas = { exclude: "Area excluded", obstacles: "Obstacle set" };
  if (areas[tool]) return edit("run", tool, [...(run.shapes[tool] || []), shape], run.name, `${areas[tool]} in ${run.name}.`);
  const key = tool === "polygon" ? "target" : tool;
  return edit("run", key, shape, run.name, `${key === "target" ? "Target" : "Reference"} set in ${run.name}.`);
}

/** Download a file; what is outdated is updated first, or taken as it is. */
export async function download(what, more = {}) {
  mark(`download.${what}`, true);
  try {
    const query = new URLSearchParams({ what, ...more });
    const blob = await (await request(`/api/download?${query}`)).blob();
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: what });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    say(`${what}: downloaded.`);
  } catch (error) {
    if (error.status === 409) update({ dialog: { kind: "outdated", what, more, reason: store.study?.report.outdated || error.message } });
    else say(error.message, "bad");
  } finally {
    mark(`download.${what}`, false);
  }
}

/** Wait until no job is running; resolves to the last one. */
export async function jobEnded() {
  while (store.starting || (store.study?.job && !store.study.job.background)) await new Promise((done) => setTimeout(done, 100));
  return store.study?.last_job;
}

/** Write the report again, then download it. */
export async function updateAndDownload(what, more = {}) {
  update({ dialog: null });
  mark(`download.${what}`, true);
  const { do: name, arguments: args } = store.study?.outdated.find((one) => one.what === "report")?.update || { do: "report" };
  if (!(await start(name, args, name === "run" ? "Run" : "Write the report"))) return mark(`download.${what}`, false);
  const last = await jobEnded();
  mark(`download.${what}`, false);
  if (last?.state === "done") await download(what, more);
}
