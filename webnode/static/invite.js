// Invitations: the page's address as QR code and text, and the steps with which a phone trusts the page's certificate.
// Loaded on demand.
import { attribute, element, words } from "./element.js";
import { ask } from "./link.js";

const KINDS = { phone: "Join with a phone", viewer: "View the team" };
const DRAWINGS = "image/svg+xml";

const STEPS = {
  "Android (Chrome)": [
    "Open the address of the certificate on the phone; ca.crt is downloaded.",
    "Settings, Security & privacy, More security settings, Encryption & credentials, Install a certificate, CA certificate, Install anyway.",
    "Choose ca.crt, then scan the first code.",
  ],
  "iPhone, iPad (Safari)": [
    "Open the address of the certificate in Safari, and allow the download.",
    "Settings, Profile Downloaded, Install.",
    "Settings, General, About, Certificate Trust Settings: switch on the node's name. Then scan the first code.",
  ],
};

// Load the style sheet before the QR code is shown.
let styled;
function style() {
  styled ??= new Promise((done) => {
    const sheet = element("link", { rel: "stylesheet", href: "/static/invite.css" });
    sheet.onload = sheet.onerror = done;
    document.head.append(sheet);
  });
  return styled;
}

// Show the SVG drawn by the node; hidden if the node lacks the library for it.
function draw(figure, svg, label) {
  figure.hidden = !svg;
  if (!svg) return;
  const drawing = document.importNode(new DOMParser().parseFromString(svg, DRAWINGS).documentElement, true);
  attribute(drawing, "role", "img");
  attribute(drawing, "aria-label", label);
  figure.replaceChildren(drawing);
}

// A text with a copy button; over http, where browsers offer no clipboard API, with execCommand.
function copied(label, id, tell) {
  const text = element("input", { id, readonly: "" });
  const button = element("button", { type: "button" }, "Copy");
  button.onclick = async () => {
    text.select();
    const done = navigator.clipboard ? await navigator.clipboard.writeText(text.value).then(() => true, () => false) : document.execCommand("copy");
    tell(done ? "Copied." : "Select the text and copy it.");
  };
  return [text, element("div", {}, element("label", { for: id }, label), element("div", { class: "row" }, text, button))];
}

function steps() {
  return Object.entries(STEPS).map(([name, lines]) =>
    element("details", {}, element("summary", {}, name), element("ol", {}, ...lines.map((line) => element("li", {}, line)))));
}

function built() {
  const line = element("p", { role: "status" });
  const tell = (text) => words(line, text);
  const parts = {
    line, tell,
    kind: element("select", { id: "i-kind" }),
    page: element("select", { id: "i-page" }),
    code: element("figure", { class: "code" }),
    hint: element("p"),
    alone: element("p", { class: "warn" }),
    plain: element("p", { class: "warn" }),
    close: element("button", { type: "button" }, "Close"),
    authority: element("figure", { class: "code" }),
    mark: element("p", { class: "mark" }),
  };
  const [link, linkRow] = copied("Link", "i-link", tell);
  const [certificate, certificateRow] = copied("Certificate", "i-certificate", tell);
  const trust = element("section", { class: "trust" },
    element("h3", {}, "If the phone warns about the connection"),
    element("p", {}, "The warning is expected: the node signs its own certificate, which the phone does not know. For one visit accept the warning: ",
      element("b", {}, "Advanced, Proceed"), " (Chrome) or ", element("b", {}, "Show Details, visit this website"), " (Safari). ",
      "For further visits let the phone trust this node, once; to switch to other web nodes, let it trust those as well:"),
    ...steps(), parts.authority, certificateRow, parts.mark);
  const choices = element("div", { class: "choices" },
    element("div", {}, element("label", { for: "i-kind" }, "Purpose"), parts.kind),
    element("div", {}, element("label", { for: "i-page" }, "Address"), parts.page));
  const dialog = element("dialog", { id: "invite", "aria-labelledby": "h-invite" },
    element("div", { class: "bar" }, element("h2", { id: "h-invite" }, "Invite"), parts.close),
    choices, parts.alone, parts.plain, parts.code, linkRow, parts.hint, line, trust);
  return { ...parts, link, certificate, trust, dialog };
}

function options(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, name]) => element("option", { value }, name)));
  select.value = chosen;
}

function show(parts, told, role) {
  const isHere = told.reaches === "machine";
  parts.alone.hidden = !isHere;
  words(parts.alone, isHere ? "Only this machine can open the page. For phones start the demonstration with make demo WEB_HOST=0.0.0.0, or a node with host = \"0.0.0.0\" below [web]." : "");
  draw(parts.code, isHere ? "" : told.code, "QR code of the link below");
  parts.link.value = told.link;
  const until = new Date(1000 * told.until).toLocaleString([], { weekday: "long", hour: "2-digit", minute: "2-digit" });
  const may = role === "phone" ? "to join the team with a phone" : "to view the team, without orders";
  words(parts.hint, `${isHere ? "The link is for a browser of this machine." : "Scan the code, or send the link."} It allows its holder ${may}, until ${until}.`);
  parts.plain.hidden = told.is_secure || role !== "phone";
  words(parts.plain, told.certificate
    ? "Browsers do not allow the camera over http. Choose an address that begins with https."
    : "Browsers do not allow the camera over http, and this node has no https. Run pip install 'swarm-node[tls]', set tls = \"auto\" below [web], and restart the node.");
  parts.trust.hidden = !told.is_secure || isHere;
  draw(parts.authority, told.certificate_code, "QR code of the certificate's address");
  parts.certificate.value = told.certificate;
  words(parts.mark, `Compare the SHA-256 fingerprint that the phone shows: ${told.fingerprint}`);
}

export async function open(model) {
  await style();
  const parts = built();
  const kinds = Object.entries(KINDS).filter(([role]) => role !== "phone" || model.has.includes("phones"));
  options(parts.kind, kinds, kinds[0][0]);
  async function invite() {
    const role = parts.kind.value;
    parts.tell("");
    try {
      const told = await ask("POST", "invitations", { role, draw: true, page: parts.page.value });
      // A node that does not know its URLs was at least reached by this address.
      told.link ??= `${location.origin}/#code=${told.token}${role === "phone" ? "/phone" : ""}`;
      told.pages ??= [location.origin];
      if (!parts.page.options.length) options(parts.page, told.pages.map((url) => [url, url]), told.pages[0]);
      show(parts, told, role);
    } catch (error) {
      parts.tell(error.message);
    }
  }
  parts.kind.onchange = invite;
  parts.page.onchange = invite;
  parts.close.onclick = () => parts.dialog.close();
  parts.dialog.onclose = () => parts.dialog.remove();
  await invite();
  document.body.append(parts.dialog);
  parts.dialog.showModal();
}
