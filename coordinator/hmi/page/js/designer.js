import { h } from "./dom.js";
export class Designer { constructor() { this.root = h("div", {}); } }
