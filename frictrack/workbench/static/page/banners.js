// Lines between the bar and the view that say what is wrong: no server, vanished files, outdated results. They never cover it.

import { html } from "./hooks.js";
import { renew, refresh } from "./actions.js";
import { Button } from "./controls.js";
import { Icon } from "./icons.js";
import { foreground } from "./selectors.js";
import { say, useStore } from "./store.js";

const GONE = "The server does not answer. Start `frictrack app` again; the page reconnects by itself.";

const Banner = ({ kind, words, children }) => html`
  <div class=${`ui-banner ${kind}`} role=${kind === "bad" ? "alert" : "status"}>
    <${Icon} name=${kind === "bad" ? "bad" : "warn"} /><span class="ui-banner-words">${words}</span>${children}
  </div>`;

/** One line for all outdated results that the same action updates; the report is said beside its button. */
function Outdated() {
  const [all, busy] = [useStore((s) => s.study?.outdated || []), useStore(foreground)];
  const groups = new Map();
  for (const one of all.filter((entry) => entry.what !== "report")) {
    const key = JSON.stringify(one.update);
    groups.set(key, [...(groups.get(key) || []), one]);
  }
  return [...groups.values()].map(
    ([{ reason, update }, ...others]) => html`
      <${Banner} kind="warn" words=${others.length ? `${reason} ${others.length} more result${others.length > 1 ? "s" : ""} with it.` : reason}>
        ${update && html`<${Button} small label="Update" why=${busy ? "Wait until the work ends, or cancel it." : null} onClick=${() => renew(update)} />`}
      <//>`,
  );
}

export function Banners() {
  const [online, refused, error, notice] = [
    useStore((s) => s.online),
    useStore((s) => s.refused),
    useStore((s) => s.study?.error),
    useStore((s) => s.notice),
  ];
  return html`
    <div class="ui-banners">
      ${online === false && html`<${Banner} kind="bad" words=${GONE} />`}
      ${refused && html`<${Banner} kind="bad" words=${refused} />`}
      ${error && html`<${Banner} kind="bad" words=${error}><${Button} small label="Read again" onClick=${refresh} /><//>`}
      ${notice?.kind === "bad" &&
      html`<${Banner} kind="bad" words=${notice.words}><${Button} small iconOnly icon="cancel" kind="quiet" label="Close this message" onClick=${() => say("")} /><//>`}
      <${Outdated} />
    </div>`;
}
