// Requests to the server. Every failure becomes an Error whose message is the sentence of the server.

const GONE = "The server does not answer.";

/** Read the error sentence of an answer. */
async function sentence(answer) {
  try {
    return (await answer.json()).error || `The server answered ${answer.status}.`;
  } catch {
    return `The server answered ${answer.status}.`;
  }
}

/** Send one request; `body` is JSON unless it is a Blob. */
export async function request(path, { body, ...more } = {}) {
  const raw = body instanceof Blob;
  const options = body === undefined ? {} : { method: "POST", body: raw ? body : JSON.stringify(body) };
  if (body !== undefined && !raw) options.headers = { "Content-Type": "application/json" };
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...options, ...more });
  } catch (cause) {
    if (cause.name === "AbortError") throw cause;
    throw Object.assign(new Error(GONE), { gone: true });
  }
  if (!answer.ok) throw Object.assign(new Error(await sentence(answer)), { status: answer.status });
  return answer;
}

const CLICK_MS = 1000; // a mouse button that is held down longer is dragged
let pressed = null; // ends when the mouse button is up

addEventListener("pointerdown", () => {
  const up = new Promise((done) => addEventListener("pointerup", () => setTimeout(done), { once: true, capture: true })); // the click comes first
  pressed = Promise.race([up, pause(CLICK_MS)]);
}, true);

/** Wait until a click has ended: what is pressed must not move away under the pointer, or the click is lost. */
export const released = () => pressed;

export const getJSON = async (path, more) => (await request(path, more).finally(released)).json();
export const post = (path, body = {}, more) => getJSON(path, { body, ...more });

/** Address with a query; empty values are left out. */
export function address(path, query) {
  const kept = Object.entries(query).filter(([, value]) => value !== undefined && value !== null && value !== "");
  return kept.length ? `${path}?${new URLSearchParams(kept)}` : path;
}

/** One picture of a film, as an ImageBitmap. */
export async function frameOf(film, n) {
  const query = { run: film.run, file: film.run ? undefined : film.file, n, v: film.version };
  return createImageBitmap(await (await request(address("/api/frame", query))).blob());
}

/** Wait for some milliseconds. */
export const pause = (ms) => new Promise((done) => setTimeout(done, ms));
