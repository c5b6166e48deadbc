/** Dark, light, or as the system has it; the choice is kept in this browser. */

const ORDER = ["system", "dark", "light"];

export function currentTheme() {
  const kept = localStorage.getItem("theme");
  return ORDER.includes(kept) ? kept : "system";
}

export function applyTheme(theme = currentTheme()) {
  if (theme === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}

/** The next of the three; returns its name. */
export function switchTheme() {
  const next = ORDER[(ORDER.indexOf(currentTheme()) + 1) % ORDER.length];
  localStorage.setItem("theme", next);
  applyTheme(next);
  return next;
}

/** True while the page is dark, whoever decided it. */
export function isDark() {
  const theme = currentTheme();
  return theme === "dark" || (theme === "system" && matchMedia("(prefers-color-scheme: dark)").matches);
}
