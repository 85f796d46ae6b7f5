// Texts for people: thin spaces before units, true minus signs, short numbers.

const THIN = "\u202f";
const RAISED = { "\u2212": "\u207b", ...Object.fromEntries([..."⁰¹²³⁴⁵⁶⁷⁸⁹"].entries()) };

const UNIT = /(\d\)?) (?=(?:[kmµμnM]?(?:g|N|m|s|Hz|px|V|rad|K)|°C?|%|\/s|frames?|\d{3})(?![a-zA-Zµ]))/g;

/** "0.350 kg" with a thin space that does not break; "-3" with a minus sign. */
export const spaced = (text) =>
  String(text ?? "")
    .replace(UNIT, `$1${THIN}`)
    .replace(/(^|[\s(])-(?=\d)/g, "$1\u2212");

/** A number with some significant digits, without an exponent where it is short. */
export function digits(value, significant = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return "\u2013";
  if (value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e6)) {
    const [factor, power] = value.toExponential(significant - 1).split("e").map((text) => text.replace("-", "\u2212").replace("+", ""));
    return `${factor} × 10${[...power].map((one) => RAISED[one]).join("")}`;
  }
  const text = Number(value.toPrecision(significant));
  const shown = Math.abs(text) >= 10_000 ? text.toLocaleString("en").replaceAll(",", THIN) : String(text);
  return shown.replace("-", "\u2212");
}

/** The number as a person would type it into the study file. */
export const typed = (value) => String(Number(value.toPrecision(6)));

export const quantity = (value, unit, significant) => `${digits(value, significant)}${unit ? THIN + unit : ""}`;

/** "1 frame", "2 frames". */
export const count = (n, noun) => `${n}${THIN}${noun}${n === 1 ? "" : "s"}`;

/** Time of day of an entry, with the date where it is not today. */
export function moment(at) {
  if (!at) return "";
  const when = new Date(typeof at === "number" ? at * 1000 : at), now = new Date();
  const clock = when.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
  return when.toDateString() === now.toDateString() ? clock : `${when.toISOString().slice(0, 10)} ${clock}`;
}
