// The little of a browser that the script of a page asks for. PAGE is the page; what happens to parts is said as text.
const said = [], listeners = {}, parts = {}, before = {}

class Part {
  constructor(name) { Object.assign(this, {name, children: [], attributes: {}}) }
  setAttribute(name, value) { this.attributes[name] = value }
  append(...children) { this.children.push(...children) }
  replaceChildren(...children) { this.children = children }
  connect(next) { return next }
  get frequency() { return {set value(hertz) { said.push(`sound of ${hertz} Hz`) }} }
  get gain() { return {} }
  start() {}
  stop() {}
  blur() {}
}

const round = value => String(value).replace(/-?\d+\.\d+/g, number => String(+(+number).toFixed(2)))

function lines(part, indent) {
  const about = [part.name]
  if (part.className) about.push(`.${part.className}`)
  if (part.textContent !== undefined) about.push(`'${part.textContent}'`)
  if (part.value !== undefined) about.push(`value ${part.value}`)
  about.push(...Object.entries(part.attributes).map(([name, value]) => `${name}=${round(value)}`))
  return [indent + about.join(" "), ...part.children.flatMap(child => lines(child, indent + "  "))]
}

function act([name, action, value]) {
  if (action === "view") source.onmessage({data: JSON.stringify(value)})
  else if (action === "lost") source.onerror()
  else if (action === "click") parts.buttons.children[value].onclick()
  else listeners[action].forEach(listen => listen(value))
  console.log([`-- ${name}`, ...said.splice(0)].join("\n"))
  for (const [id, part] of Object.entries(parts)) {
    const now = lines(part, "").join("\n")
    if (now !== before[id]) console.log(now)
    before[id] = now
  }
}

Object.assign(globalThis, {
  document: {
    createElement: name => new Part(name),
    createElementNS: (_, name) => new Part(name),
    getElementById: id => {
      if (!PAGE.includes(`id="${id}"`)) throw Error(`the page has no ${id}`)
      return parts[id] ??= new Part(id)
    },
  },
  location: {search: ""},
  addEventListener: (kind, listen) => (listeners[kind] ??= []).push(listen),
  fetch: (path, {method, body}) => said.push(`${method} ${path} ${body}`),
  EventSource: class { constructor() { globalThis.source = this } },
  AudioContext: class {
    createOscillator() { return new Part("oscillator") }
    createGain() { return new Part("gain") }
  },
})
