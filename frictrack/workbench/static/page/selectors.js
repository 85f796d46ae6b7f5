// Parts of the store that several components show.

/** Work that nobody waits for: the papers' route and the report after a verdict, and candidates that are fitted to be shown. */
export const isQuiet = (job) => job.background || ["attempt", "background"].includes(job.do);

/** The job that holds the user up, or the one that was just asked for. */
export const foreground = (s) => {
  const job = s.study?.job;
  if (job && !isQuiet(job) && job.state === "running") return job;
  return s.starting && { ...s.starting, done: 0, total: 0, what: "starting" };
};

/** The model that Compare shows: the chosen one, else the current one. */
export const shownModel = (s) => s.study?.models?.find((one) => (s.shown ? one.group === s.shown : one.current)) || s.study?.models?.find((one) => one.current) || null;

/** The model in the background, if it still exists. */
export const backgroundModel = (s) => (s.study?.models?.some((one) => one.group === s.background) ? s.background : "");

const MEASURE = "Measure the runs";
export const STEPS_OF_RUN = [MEASURE, "Fit the model", "Find what is missing"];

/** What is known of a run: one whose results are outdated waits to be measured again. */
export function stateOf(s, run) {
  const old = (s.study?.outdated || []).some((one) => ["track", "motion"].includes(one.what) && one.name === run.name);
  return old && run.state === "measured" ? "new" : run.state;
}

/** How far a job is: its step, and the share of this step that is done; null where it is not known. Of the measurement, runs
 *  count that are finished. */
export function progressOf(s, job) {
  if (job.step !== MEASURE) return { step: job.step || job.words, share: job.total > 1 ? job.done / job.total : null };
  const runs = s.study?.runs || [], done = runs.filter((run) => stateOf(s, run) === "measured").length;
  return { step: `${MEASURE}: ${done} of ${runs.length}`, share: done / (runs.length || 1) };
}

/** Why one of these results is outdated; empty if none is. */
export function outdatedWords(s, ...what) {
  return (s.study?.outdated || []).filter((one) => what.includes(one.what)).map((one) => one.reason)[0] || "";
}

/** Film of a run as the plots and the film view expect it; null if the run has none. */
export const filmOf = (run) =>
  run?.film ? { ...run.film, run: run.name, shapes: run.shapes, suspect: run.suspect, repairs: run.repairs } : null;
