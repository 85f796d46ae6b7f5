// Light or dark colours: what the user chose, else what the system prefers.

import { useEffect, useState } from "./hooks.js";

const KEY = "frictrack.theme";
const system = matchMedia("(prefers-color-scheme: dark)");
const current = () => localStorage.getItem(KEY) || (system.matches ? "dark" : "light");

function apply() {
  document.documentElement.dataset.theme = current();
  dispatchEvent(new Event("frictrack-theme"));
}

apply();
system.addEventListener("change", apply);

export function toggleTheme() {
  localStorage.setItem(KEY, current() === "dark" ? "light" : "dark");
  apply();
}

export function useTheme() {
  const [theme, setTheme] = useState(current);
  useEffect(() => {
    const look = () => setTheme(current());
    addEventListener("frictrack-theme", look);
    return () => removeEventListener("frictrack-theme", look);
  }, []);
  return theme;
}
