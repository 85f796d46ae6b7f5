// Sections open when a link leads into them, all at once by the button, and on paper. Without a script they open by a click.
const sections = [...document.querySelectorAll("details.section")];
const button = document.getElementById("all");
const setAll = (open) => {
  for (const section of sections) section.open = open;
  button.textContent = open ? "Close all sections" : "Open all sections";
};
const reveal = () => {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  const section = target && target.closest("details.section");
  if (!section) return;
  section.open = true;
  section.scrollIntoView();
};
button.hidden = false;
button.addEventListener("click", () => setAll(!sections.every((section) => section.open)));
addEventListener("hashchange", reveal);
for (const link of document.querySelectorAll('a[href^="#"]')) link.addEventListener("click", () => setTimeout(reveal));
addEventListener("beforeprint", () => setAll(true));
reveal();
