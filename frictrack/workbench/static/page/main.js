// The page: header, bar, banners, the chosen view and the status bar.

import { html, render, useEffect } from "./hooks.js";
import "./theme.js";
import { Banners } from "./banners.js";
import { CompareTab } from "./compare_tab.js";
import { Skeleton } from "./controls.js";
import { Dialogs } from "./dialogs.js";
import { FilmTab } from "./film_tab.js";
import { followFocus, returnFocus } from "./focus.js";
import { Header } from "./header.js";
import { HistoryTab } from "./history_tab.js";
import { listen } from "./keys.js";
import { connect } from "./live.js";
import { followAddress } from "./place.js";
import { readGlossary } from "./words.js";
import { ModelTab } from "./model_tab.js";
import { MotionTab } from "./motion_tab.js";
import { SetupBar } from "./setup_bar.js";
import { StatusBar } from "./status_bar.js";
import { useStore } from "./store.js";

const VIEWS = { film: FilmTab, compare: CompareTab, motion: MotionTab, model: ModelTab, history: HistoryTab };

function App() {
  const [tab, name, online] = [useStore((s) => s.tab), useStore((s) => s.study?.name), useStore((s) => s.online)];
  useEffect(() => {
    document.title = name ? `${name} – frictrack` : "frictrack";
  }, [name]);
  useEffect(() => returnFocus(tab), [tab]);
  const View = VIEWS[tab] || FilmTab, read = useStore((s) => s.study?.exists !== undefined);
  return html`
    <${Header} />
    <${SetupBar} />
    <${Banners} />
    <main class=${`ui-view ${online === false ? "offline" : ""}`}>
      <div id="view" role="tabpanel" aria-labelledby=${`tab-${tab}`} tabindex="-1">
        ${read ? html`<${View} key=${tab} />` : html`<${Skeleton} label="Reading the study ..." height=${400} />`}</div>
    </main>
    <${StatusBar} />
    <${Dialogs} />`;
}

document.getElementById("app").replaceChildren();
followAddress();
render(html`<${App} />`, document.getElementById("app"));
listen();
followFocus();
connect();
readGlossary().catch(() => {});
