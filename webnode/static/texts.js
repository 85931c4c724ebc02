// Texts: the language of the page, its catalogue, and numbers and times as the language writes them.
// A new language is a catalogue in texts/ with the keys of texts/en.js, and its code in this list.
const LANGUAGES = ["en", "de"];

// `locale` also contains the region, which decides on the format of numbers and times.
const known = navigator.languages.map((tag) => [tag.split("-")[0], tag]).find(([code]) => LANGUAGES.includes(code));
const [language, locale] = known ?? [LANGUAGES[0], LANGUAGES[0]];
const { default: catalogue } = await import(`./texts/${language}.js`);
const plurals = new Intl.PluralRules(locale);
const clock = new Intl.DateTimeFormat(locale, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const calendar = new Intl.DateTimeFormat(locale, { dateStyle: "medium" });
const moment = new Intl.DateTimeFormat(locale, { weekday: "long", hour: "2-digit", minute: "2-digit" });
const numbers = new Map();

// Format with `digits` fractional digits, by default with all digits of the number, at most three.
export function formatNumber(value, digits) {
  if (!numbers.has(digits)) {
    const options = { minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: "min2" };
    numbers.set(digits, new Intl.NumberFormat(locale, options));
  }
  return numbers.get(digits).format(value);
}

// Times are unix seconds.
export const formatTime = (seconds) => clock.format(1000 * seconds);
export const formatDate = (seconds) => calendar.format(1000 * seconds);
export const formatMoment = (seconds) => moment.format(1000 * seconds);

// The text of a key, with its placeholders replaced.  A text with plural forms is chosen by `values.count`.
export function text(key, values = {}) {
  const entry = catalogue[key] ?? key;
  const form = typeof entry === "string" ? entry : entry[plurals.select(values.count)] ?? entry.other;
  return form.replace(/\{(\w+)\}/g, (_, name) => (typeof values[name] === "number" ? formatNumber(values[name]) : values[name]));
}

// The text of a code that a node sent, or `otherwise` if the catalogue lacks the code.
export function textOf(family, code, otherwise = code) {
  const key = `${family}.${code}`;
  return Object.hasOwn(catalogue, key) ? text(key) : otherwise;
}

// Fill the texts of the document; the style sheet hides the page until this is done.
const ATTRIBUTES = { textLabel: "aria-label", textPlaceholder: "placeholder" };
for (const node of document.querySelectorAll("[data-text]")) node.textContent = text(node.dataset.text);
for (const [name, attribute] of Object.entries(ATTRIBUTES)) {
  const selector = `[data-${name.replace(/[A-Z]/, (letter) => `-${letter.toLowerCase()}`)}]`;
  for (const node of document.querySelectorAll(selector)) node.setAttribute(attribute, text(node.dataset[name]));
}
document.documentElement.lang = language;
document.documentElement.dataset.texts = "";
