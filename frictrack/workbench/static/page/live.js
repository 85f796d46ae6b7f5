// The connection to the server: the state of the study after every change, and whether the server still answers.

import { getJSON, released } from "./api.js";
import { isQuiet } from "./selectors.js";
import { say, store, update } from "./store.js";

const PING_MS = 2000; // the server answers each of them
const SILENT_MS = 5000; // without an answer the server is taken as gone
const RETRY_MS = 800;

let server = null; // id of the process that answered last
let heard = 0;
let news = 0; // when something was heard of the study or its work
let socket = null;

/** Take a new state, unless a newer one has already been shown. */
export function receive(state) {
  const old = store.study;
  if (old && state.server === old.server && state.version < old.version) return;
  const told = state.job || (store.starting && Date.now() - store.starting.at > SILENT_MS);
  update({ study: state, starting: told ? null : store.starting });
  if (old) announceEnd(old.last_job, state.last_job);
}

function receiveJob({ job, last_job: last }) {
  if (!store.study) return;
  const before = store.study.last_job;
  update({ study: { ...store.study, job, last_job: last ?? before }, starting: job ? null : store.starting });
  announceEnd(before, last);
}

/** Say that a job has ended, whichever message tells it first: that of the job or a whole state. */
function announceEnd(before, last) {
  if (last && (last.id !== before?.id || last.state !== before?.state)) tellEnd(last);
}

const ENDS = {
  done: (job) => [`${job.words}: done.`, "done"],
  failed: (job) => [`${job.words}: ${job.error}`, "bad"],
  cancelled: (job) => [`${job.words}: cancelled. Finished steps are kept.`, "warn"],
  interrupted: (job) => [`${job.words}: interrupted. Finished steps are kept; start it again to continue.`, "bad"],
};

/** Say how a job ended. */
function tellEnd(job) {
  update({ starting: null });
  if (!ENDS[job.state] || job.do === "attempt" || (isQuiet(job) && job.state !== "failed")) return;
  const [words, kind] = ENDS[job.state](job);
  const warned = (job.warnings || []).map((one) => one.words || one);
  say([words, ...warned].join(" "), warned.length && kind === "done" ? "warn" : kind);
}

async function readState() {
  try {
    receive(await getJSON("/api/state"));
    update({ online: true, refused: "" });
  } catch (error) {
    if (error.status === 401 || error.status === 403) update({ online: true, refused: error.message });
    else if (error.gone) update({ online: false });
    else say(error.message, "bad");
  }
}

async function onMessage(event) {
  heard = Date.now();
  await released();
  const message = JSON.parse(event.data);
  if (message.type !== "pong") news = heard;
  if (message.type === "hello") {
    if (server && server !== message.server) say("The server was started again; the page is connected.", "done");
    server = message.server;
  } else if (message.type === "state") receive(message.state);
  else if (message.type === "job") receiveJob(message);
  if (store.online !== true) update({ online: true });
}

function open() {
  const { protocol, host } = location;
  const mine = (socket = new WebSocket(`${protocol === "https:" ? "wss" : "ws"}://${host}/api/events`));
  heard = Date.now();
  mine.onopen = readState;
  mine.onmessage = onMessage;
  mine.onclose = () => {
    if (mine !== socket) return;
    socket = null;
    if (store.online !== false) update({ online: false });
    setTimeout(open, RETRY_MS);
  };
}

/** Ask whether the server is there; a silent one is taken as gone. Work of which nothing is heard is asked for. */
function ping() {
  if ((store.study?.job || store.starting) && Date.now() - news > SILENT_MS && store.online) {
    news = Date.now();
    readState();
  }
  if (socket?.readyState !== WebSocket.OPEN) return;
  if (Date.now() - heard > SILENT_MS) {
    const silent = socket;
    silent.close();
    silent.onclose();
  } else socket.send(JSON.stringify({ type: "ping" }));
}

/** Connect, and stay connected. */
export function connect() {
  readState();
  open();
  setInterval(ping, PING_MS);
}
