// The theme: light or dark if the visitor chose so, otherwise the system's theme.
export const STORAGE_KEY = "swarm.theme";

export function readTheme() {
  try {
    return /^(light|dark)$/.exec(localStorage.getItem(STORAGE_KEY))?.[0] ?? "light dark";
  } catch {
    return "light dark";
  }
}

// Set before the first drawing, to avoid a change of colours.
document.documentElement.style.colorScheme = readTheme();
