// The little of a browser that the script of a page asks for. PAGE is the page; what happens to parts is said as text.
const said = [], listeners = {}, parts = {}, before = {}, frames = [], post = globalThis.fetch
let focused = null, server = "", waiting = 0, given = {}, size = {width: 600, height: 300}

class Part {
  constructor(name, attributes = {}) { Object.assign(this, {name, children: [], attributes}) }
  get dataset() { return {do: this.attributes["data-do"]} }
  setAttribute(name, value) { this.attributes[name] = value }
  append(...children) { this.children.push(...children) }
  replaceChildren(...children) { this.children = children }
  contains(part) { return this.children.includes(part) }
  connect(next) { return next }
  get frequency() { return {set value(hertz) { said.push(`sound of ${hertz} Hz`) }} }
  get gain() { return {} }
  start() {} stop() {} blur() {}
  focus() {
    if (focused === this) return
    focused = this
    this.onfocus?.()
    said.push(`focus on ${this.attributes["aria-label"] ?? this.name}`)
  }
  addEventListener(kind, listen) { this[`on${kind}`] = listen }
  setPointerCapture(pointer) { said.push(`${this.name} captures pointer ${pointer}`) }
  getScreenCTM() { return {inverse: () => ({x, y}) => ({x: (x - 100) / 2, y: (y - 50) / 2})} } // two pixels a unit
  get classList() {
    const names = new Set(this.attributes.class?.split(" "))
    return {toggle: (name, on) => { names[on ? "add" : "delete"](name); this.attributes.class = [...names].join(" ") }}
  }
  get options() { return this.children }
  get text() { return this.textContent } set text(text) { this.textContent = text }
  add(option) { this.children.push(option); this.selectedIndex ??= 0 }
  remove(index) { this.children.splice(index, 1) }
  querySelectorAll(name) { return elements(name) } querySelector(name) { return elements(name)[0] }
  get clientWidth() { return size.width } get clientHeight() { return size.height }
  getContext() { return new Proxy(given = {}, {get: (_, name) => webgl(this, name)}) }
}

// The elements of a name on the page: parts by their id or what they do.
function elements(name) {
  return [...PAGE.matchAll(RegExp(`<${name}\\b([^>]*)>`, "g"))].map(([_, text]) => {
    const about = Object.fromEntries([...text.matchAll(/(\S+)="([^"]*)"/g)].map(([_, key, value]) => [key, value]))
    const id = about.id ?? about["data-do"] ?? name
    return parts[id] ??= new Part(id, about)
  })
}

// Calls as text without what was given before. A constant is its name, but for bits; a call returns its last value.
function webgl(canvas, name) {
  if (name.startsWith("drawingBuffer")) return canvas[name.slice(13).toLowerCase()]
  if (/^[A-Z_]+$/.test(name)) return {COLOR_BUFFER_BIT: 16384, DEPTH_BUFFER_BIT: 256}[name] ?? name
  return (...values) => {
    const texts = values.map(value => value?.buffer ? Buffer.from(value).toString("hex") : round(value, 3))
    const text = [name, ...texts].join(" "), call = name + texts[0], isNew = given[call] !== text
    if (name === "drawElements" || isNew && /^(clear|enable$|buffer|uniform|vertex|view)/.test(name)) said.push(text)
    given[call] = text
    return values.at(-1)
  }
}

const round = (value, digits = 2) =>
  String(value).replace(/-?\d+\.\d+(e-?\d+)?/g, number => String(+(+number).toFixed(digits) + 0))

// A part with its children in brackets; a long value that the part before it has too is left out.
function line(part, k, row) {
  const texts = [part.name], former = row?.[k - 1]?.attributes
  if (part.className) texts.push(`.${part.className}`)
  if (part.textContent !== undefined) texts.push(`'${part.textContent}'`)
  for (const name of ["value", "selectedIndex", "width", "height"])
    if (name in part) texts.push(`${name} ${part[name]}`)
  for (const name of ["disabled", "hidden"]) if (part[name]) texts.push(name)
  texts.push(...Object.entries(part.attributes).map(([name, value]) =>
    `${name}=${value.length > 20 && value === former?.[name] ? "..." : round(value)}`))
  return texts.join(" ") + (row && part.children.length ? ` (${part.children.map(line).join(", ")})` : "")
}

// What has changed of a part: itself, and each child by its number.
function changes(id, part) {
  const now = [line(part) + (part.children.length ? `, ${part.children.length} parts` : "")], old = before[id] ?? []
  now.push(...part.children.map((child, k) => `${id} ${k + 1} ${line(child, 0, [])}`))
  before[id] = now
  return now.filter(text => !old.includes(text))
}

// The event of a key, such as "Ctrl+Shift+z".
function press(text) {
  const held = text.split(/\b\+/), key = held.pop()
  return {key, shiftKey: held.includes("Shift"), ctrlKey: held.includes("Ctrl"), altKey: held.includes("Alt")}
}

function happen(action, value) {
  const [id, ...rest] = action.split(" "), kind = rest.pop() ?? id
  const event = {preventDefault: () => said.push("kept from the browser"), ...value}
  if (kind === "view") return source.onmessage({data: JSON.stringify(value)})
  if (kind === "lost") return source.onerror()
  if (kind === "server") return server = value
  if (kind === "size") size = value
  if (kind === id) return listeners[kind].forEach(listen => listen(event))
  const part = rest.reduce((parent, number) => parent.children[number], parts[id])
  if (kind === "change") part.selectedIndex = value
  kind === "focus" ? part.focus() : part[`on${kind}`](event)
}

// One action after another, each with all that follows from it; the events of one action come before any response.
async function run(actions) {
  for (const [name, action, values] of actions) {
    const keys = /keydown$/.test(action) && values.split?.(" ").map(press)
    for (const value of keys || [values].flat()) happen(action, value)
    do await new Promise(setImmediate); while (waiting)
    frames.splice(0).forEach(draw => draw())
    const shown = Object.entries(parts).flatMap(([id, part]) => changes(id, part))
    console.log([`-- ${name}`, ...said.splice(0), ...shown].join("\n"))
  }
}

Math.random = () => .5
Object.defineProperty(performance, "timeOrigin", {value: 7})
Object.assign(globalThis, {
  document: {
    createElement: name => new Part(name),
    createElementNS: (_, name) => new Part(name),
    getElementById: id => {
      if (!PAGE.includes(`id="${id}"`)) throw Error(`the page has no ${id}`)
      const content = PAGE.match(`id="${id}">({[^<]*)<`)?.[1]
      return parts[id] ??= Object.assign(new Part(id), content && {textContent: content})
    },
    querySelectorAll: elements,
    get activeElement() { return focused },
  },
  window: globalThis,
  devicePixelRatio: 2,
  location: {search: ""},
  addEventListener: (kind, listen) => (listeners[kind] ??= []).push(listen),
  requestAnimationFrame: draw => frames.push(draw),
  // There is no response without a server.
  fetch: async (path, {method, body}) => {
    said.push(`${method} ${path} ${body}`)
    if (!server) return
    waiting += 1
    const [{ok}, text] = await post(server + path, {method, body, headers: {Origin: server}})
      .then(async response => [response, await response.text()]).finally(() => { waiting -= 1 })
    return {ok, text: async () => text, json: async () => JSON.parse(text)}
  },
  DOMPoint: function (x, y) { this.matrixTransform = transform => transform({x, y}) },
  Option: class extends Part { constructor(text) { super("option").text = text } },
  ResizeObserver: function (listen) { this.observe = () => { listeners.size = [listen] } },
  EventSource: class { constructor() { globalThis.source = this } },
  AudioContext: class {
    createOscillator() { return new Part("oscillator") }
    createGain() { return new Part("gain") }
  },
})
