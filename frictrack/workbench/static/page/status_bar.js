// Last line of the page: what was done, the work under way, and whether the server answers.

import { html } from "./hooks.js";
import { Icon } from "./icons.js";
import { spaced } from "./format.js";
import { isQuiet } from "./selectors.js";
import { useStore } from "./store.js";

function working(s) {
  const job = s.study?.job;
  const count = job?.total > 1 ? ` ${job.done} of ${job.total}` : "";
  if (job?.state === "running" && isQuiet(job)) return `In the background: ${job.what ? job.what + count : job.words}`;
  if (job?.state === "running") return s.tab === "compare" ? job.words : `${job.words}: ${job.what || "starting"}`; // Compare says it larger
  return s.starting ? `${s.starting.words}: starting` : "";
}

export function StatusBar() {
  const [notice, work, online, path, busy] = [
    useStore((s) => s.notice),
    useStore(working),
    useStore((s) => s.online),
    useStore((s) => s.study?.path),
    useStore((s) => s.busy.size > 0),
  ];
  const words = work || (notice?.kind === "bad" ? "" : notice?.words) || "";
  return html`
    <footer class="ui-status">
      <p class=${`ui-message ${work ? "" : notice?.kind || ""}`} role="status">
        ${work || busy ? html`<span class="ui-spinner"></span>` : words && html`<${Icon} name=${notice?.kind === "warn" ? "warn" : "good"} />`}
        <span>${spaced(words)}</span>
      </p>
      <p class="ui-path" title=${path}><bdi>${path}</bdi></p>
      <p class=${`ui-online ${online === false ? "bad" : ""}`}><span class="ui-dot"></span>${online === false ? "no server" : online ? "connected" : "connecting"}</p>
    </footer>`;
}
