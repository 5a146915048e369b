/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* The analog-to-digital converter after the ATmega328P datasheet, chapter "ADC"; simavr's own
 * computes the value when ADCL is read and knows no trigger from timer 1.
 *
 * Phases of a conversion, in ADC clocks after its start:
 *                      hold    end
 *   first after ADEN   13.5    25
 *   single, free run    1.5    13
 *   auto triggered      2      13.5
 *
 * The sample capacitor is joined to its channel from the last ADC clock of a conversion on, where
 * the channel is unlocked, until the next hold. With track_late it is joined only when the next
 * conversion begins: the data sheet does not say which.
 */
#include "skinsim.h"

#include <math.h>

#include <simavr/avr_adc.h>
#include <simavr/sim_interrupts.h>

enum { ADC_L = 0x78, ADC_H = 0x79, ADCSRA_ = 0x7A, ADCSRB_ = 0x7B, ADMUX_ = 0x7C };
enum { ADEN_ = 0x80, ADSC_ = 0x40, ADATE_ = 0x20, ADIF_ = 0x10, ADPS_ = 0x07 };
enum { ADLAR_ = 0x20, REFS_ = 0xC0, REFS_AVCC = 0x40, MUX_ = 0x1F, MUX5_ = 0x08, ADTS_ = 0x07 };

enum phase { IDLE, WAITING, SAMPLING, HOLDING, TRACKING };

static struct {
    avr_int_vector_t *vector;
    enum phase phase;
    bool first;         /* the next conversion is the long one */
    instant prescaler;  /* when the prescaler was last at zero */
    instant start, end; /* of the conversion in progress */
    unsigned divider;   /* CPU cycles in one ADC clock, of the conversion in progress */
    double hold_clocks, all_clocks;
    unsigned channel; /* its node, connected to the sample and hold */
    uint16_t code, result;
    bool locked, unread; /* ADCL read and ADCH not; result not read */
} adc;

static unsigned divider(void) {
    const unsigned adps = cpu->data[ADCSRA_] & ADPS_;
    return 1u << (adps ? adps : 1);
}

/* A channel without a node is numbered behind the nodes. */
static unsigned selected_channel(void) {
    const unsigned channel = (cpu->data[ADMUX_] & MUX_) | (cpu->data[ADCSRB_] & MUX5_) << 2;
    const unsigned node = skin_node_at(channel);
    return node < NODES ? node : NODES + channel;
}

static bool multiplexer_is_free(void) {
    return adc.phase == IDLE || adc.phase == WAITING || adc.phase == TRACKING;
}

/* A moment at which the sample capacitor may join its channel: a conversion begins, or not. */
static void may_join(bool begins, instant when) {
    if (begins == (settings.track_late != 0))
        skin_connect(adc.channel, when);
}

static void connect_channel(instant when) {
    if (selected_channel() == adc.channel)
        return;
    adc.channel = selected_channel();
    may_join(false, when);
    stats_channel_changed(when);
}

static unsigned trigger_source(void) { return cpu->data[ADCSRB_] & ADTS_; }

/* The multiplexer is locked from `start` to the end of the conversion. */
static void begin(instant start, double hold_clocks, double all_clocks) {
    adc.divider = divider();
    adc.hold_clocks = adc.first ? 13.5 : hold_clocks;
    adc.all_clocks = adc.first ? 25 : all_clocks;
    adc.first = false;
    adc.start = start;
    adc.end = start + (instant)(adc.all_clocks * adc.divider) + (instant)settings.late_cycles;
    cpu->data[ADCSRA_] |= ADSC_;
    adc.phase = WAITING;
    events_set(EVENT_ADC, start);
}

/* Of a normal distribution with deviation 1, by the method of Box and Muller; the same for a seed.
 */
static double noise(void) {
    static double seed = -1;
    static uint64_t state;
    double uniform[2];
    if (seed != settings.seed)
        state = (uint64_t)(seed = settings.seed);
    for (int i = 0; i < 2; i++) { /* splitmix64 */
        uint64_t mixed = state += 0x9E3779B97F4A7C15;
        mixed = (mixed ^ mixed >> 30) * 0xBF58476D1CE4E5B9;
        mixed = (mixed ^ mixed >> 27) * 0x94D049BB133111EB;
        uniform[i] = (double)((mixed ^ mixed >> 31) >> 11) * 0x1p-53;
    }
    return sqrt(-2 * log(1 - uniform[0])) * cos(2 * M_PI * uniform[1]);
}

/* What the ideal converter would have to see to give this one's code [LSB]. */
static double with_errors(double ratio) {
    const struct settings *s = &settings;
    const unsigned clock = cpu->data[ADCSRA_] & ADPS_;
    const double bow = 4 * ratio * (1 - ratio);
    return ratio * 1024 + s->half_code / 2 + s->offset_lsb[clock] + s->gain_lsb[clock] * ratio +
           s->inl_lsb[clock] * bow + (s->noise_lsb[clock] > 0 ? s->noise_lsb[clock] * noise() : 0);
}

static void hold(instant when) {
    const double ratio = adc.channel < NODES ? skin_ratio(adc.channel, when) : 0.0;
    const double code = floor(with_errors(ratio));
    adc.code = code > 1023 ? 1023 : code > 0 ? (uint16_t)code : 0;
    if ((cpu->data[ADMUX_] & REFS_) != REFS_AVCC)
        stats.reference_not_avcc++;
    stats_hold(when, adc.channel, adc.code);
    skin_connect(NODES, when); /* the capacitor keeps what it has while the converter works */
}

static void finish(instant when) {
    const uint8_t control = cpu->data[ADCSRA_];
    if (adc.locked || adc.unread)
        stats.lost_results++;
    if (!adc.locked) {
        adc.result = adc.code;
        adc.unread = true;
    }
    adc.phase = IDLE;
    cpu->data[ADCSRA_] = control & (uint8_t)~ADSC_;
    if ((control & ADATE_) && trigger_source() == ADC_TRIGGER_FREE)
        begin(when, 1.5, 13);
    avr_raise_interrupt(cpu, adc.vector);
}

static void on_event(instant due) {
    switch (adc.phase) {
    case IDLE:
        break;
    case WAITING:
        stats_conversion_started(due);
        may_join(true, due);
        adc.phase = SAMPLING;
        events_set(EVENT_ADC, adc.start + (instant)(adc.hold_clocks * adc.divider));
        break;
    case SAMPLING:
        hold(due);
        adc.phase = HOLDING;
        events_set(EVENT_ADC, adc.end - adc.divider);
        break;
    case HOLDING: /* a channel written meanwhile is connected in the conversion's last ADC clock */
        adc.phase = TRACKING;
        may_join(false, due);
        connect_channel(due);
        events_set(EVENT_ADC, adc.end);
        break;
    case TRACKING:
        finish(due);
        break;
    }
}

/* ADSC was written: the conversion starts with the next rising edge of the ADC clock. The
 * datasheet does not give the phase after ADEN; here edges are whole ADC clocks after it. */
static void start_single(instant when) {
    const instant clocks = (when - adc.prescaler) / divider() + 1;
    begin(adc.prescaler + clocks * divider(), 1.5, 13);
}

static void trigger(instant when) {
    const uint8_t control = cpu->data[ADCSRA_];
    if (!(control & ADEN_) || !(control & ADATE_) || adc.phase != IDLE)
        return;
    adc.prescaler = when + 3; /* prescaler reset, after three cycles of synchronisation */
    begin(adc.prescaler, 2, 13.5);
}

void adc_trigger_edge(enum adc_trigger source, instant when) {
    if (trigger_source() == source)
        trigger(when);
}

static bool trigger_flag(unsigned source);

static void write_adcsra(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    const instant when = cpu_write_instant();
    events_until(when);
    const uint8_t old = avr->data[address];
    uint8_t now = (value & (uint8_t)~(ADSC_ | ADIF_)) | (old & (ADSC_ | ADIF_));
    avr->data[address] = now;
    if (value & ADIF_) {
        cpu_clear_interrupt(adc.vector);
    }
    if (!(now & ADEN_)) {
        adc.phase = IDLE;
        events_set(EVENT_ADC, NEVER);
        avr->data[address] &= (uint8_t)~ADSC_;
        return;
    }
    if (!(old & ADEN_)) {
        adc.first = true;
        adc.prescaler = when;
    }
    if ((value & ADSC_) && adc.phase == IDLE)
        start_single(when);
    if (multiplexer_is_free())
        connect_channel(when);
    /* The datasheet does not say whether a flag that is set already counts as an edge. */
    if ((now & ADATE_) && !(old & ADATE_) && trigger_flag(trigger_source()))
        trigger(when);
    cpu_retry_interrupt(adc.vector);
}

static bool trigger_flag(unsigned source) {
    if (source == ADC_TRIGGER_TIMER1_B)
        return timer1_flag(2);
    if (source == ADC_TRIGGER_TIMER1_OVERFLOW)
        return timer1_flag(0);
    return false;
}

static void write_mux(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    const instant when = cpu_write_instant();
    events_until(when);
    const unsigned old_source = trigger_source();
    avr->data[address] = value;
    if (multiplexer_is_free())
        connect_channel(when);
    const unsigned source = trigger_source();
    if (source == old_source)
        return;
    if (source != ADC_TRIGGER_FREE && source != ADC_TRIGGER_TIMER1_B &&
        source != ADC_TRIGGER_TIMER1_OVERFLOW)
        stats.unmodelled_triggers++;
    if (trigger_flag(source) && !trigger_flag(old_source))
        trigger(when); /* the edge seen by the trigger logic when it is switched over */
}

static uint16_t adjusted_result(void) {
    return cpu->data[ADMUX_] & ADLAR_ ? (uint16_t)(adc.result << 6) : adc.result;
}

static uint8_t read_adcl(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)avr, (void)address, (void)param;
    events_until(cpu_read_instant());
    adc.locked = true;
    return (uint8_t)adjusted_result();
}

static uint8_t read_adch(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)avr, (void)address, (void)param;
    events_until(cpu_read_instant());
    adc.locked = adc.unread = false;
    return (uint8_t)(adjusted_result() >> 8);
}

static uint8_t read_adcsra(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)param;
    events_until(cpu_read_instant());
    return avr->data[address];
}

static void write_nothing(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)avr, (void)address, (void)value, (void)param;
}

void adc_start(void) {
    avr_adc_t *stock = cpu_find_io("adc", 0);
    stock->io.reset = NULL;
    adc.vector = &stock->adc;
    events_handle(EVENT_ADC, on_event);
    cpu_on_write(ADCSRA_, write_adcsra, NULL);
    cpu_on_write(ADCSRB_, write_mux, NULL);
    cpu_on_write(ADMUX_, write_mux, NULL);
    cpu_on_write(ADC_L, write_nothing, NULL);
    cpu_on_write(ADC_H, write_nothing, NULL);
    cpu_on_read(ADCSRA_, read_adcsra, NULL);
    cpu_on_read(ADC_L, read_adcl, NULL);
    cpu_on_read(ADC_H, read_adch, NULL);
}

void adc_reset(void) {
    adc.phase = IDLE;
    adc.channel = selected_channel();
    skin_connect(adc.channel, cpu->cycle);
    adc.result = 0;
    adc.locked = adc.unread = false;
    events_set(EVENT_ADC, NEVER);
}
