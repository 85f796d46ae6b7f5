// Parts of the store that several components show.

/** Work that nobody waits for: the papers' route and the report after a verdict, and candidates that are fitted to be shown. */
export const isQuiet = (job) => job.background || ["attempt", "background"].includes(job.do);

/** The job that holds the user up, or the one that was just asked for. */
export const foreground = (s) => {
  const job = s.study?.job;
  if (job && !isQuiet(job) && job.state === "running") return job;
  return s.starting && { ...s.starting, done: 0, total: 0, what: "starting" };
};

/** Why one of these results is outdated; empty if none is. */
export function outdatedWords(s, ...what) {
  return (s.study?.outdated || []).filter((one) => what.includes(one.what)).map((one) => one.reason)[0] || "";
}

/** Film of a run as the plots and the film view expect it; null if the run has none. */
export const filmOf = (run) =>
  run?.film ? { ...run.film, run: run.name, shapes: run.shapes, suspect: run.suspect, repairs: run.repairs } : null;
